"""Settings of every command: presets in YAML, and the declaration and check of config values.

It needs neither Hydra nor numerical libraries and imports no other package of the project, so every package may import
it.
"""
