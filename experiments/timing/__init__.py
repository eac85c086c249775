"""How fast things are, each beside a named rival that does the same work in the same run.

Entered by speed."""
