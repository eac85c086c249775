"""How requests travel: HTTP, serial line, and the lock that keeps a second master out.

Entered by drivers. Knows bytes, no device."""
