"""A DQN from scratch that learns from any vector environment; of ours it imports only `conf`.

Reader's path for one update: trainer.py, agent.py, replay.py, targets.py (and network.py for the arithmetic).
Nothing is imported here, so that `dqn.policy` loads where torch is absent.
"""
