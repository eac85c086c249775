"""What can be told to a command: presets in YAML, old names, and how a config states and checks its own values.

Free of Hydra and of everything numerical, so every package may import it; it imports nothing of ours.
"""
