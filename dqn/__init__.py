"""DQN from scratch that learns from any vector environment. Of this project the package imports only `conf`.

To follow one update, read trainer.py, agent.py, replay.py and targets.py in this order; network.py has the arithmetic.
This file imports nothing, so that `dqn.policy` loads without torch.
"""
