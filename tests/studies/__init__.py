"""What the choices of an agent are worth."""
