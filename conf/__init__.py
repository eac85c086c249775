"""Presets: the values by which one plant, agent, backend or recipe differs from the defaults of its dataclass."""
