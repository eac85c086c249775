"""How fast things are, each beside a named rival in the same run.

Entered by speed."""
