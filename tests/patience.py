"""How long a test waits for what another process does: a busy machine is slow, and no test is about that."""

PATIENCE_S = 600.0
