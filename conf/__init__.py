"""The settings of every command: presets in YAML, and how a config states and checks its own values.

Free of Hydra and of everything numerical, so every package may import it; it imports nothing of ours.
"""
