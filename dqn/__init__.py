"""A DQN from scratch that learns from any vector environment; of this project it imports only `conf`.

Files to read for one update, in order: trainer.py, agent.py, replay.py, targets.py (and network.py for the arithmetic).
This file imports nothing, so that `dqn.policy` loads without torch.
"""
