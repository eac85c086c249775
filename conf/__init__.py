"""Settings of every command: presets in YAML, and the declaration and check of config values.

The package needs neither Hydra nor numerical libraries. It imports no other package of the project, so every package
may import it.
"""
