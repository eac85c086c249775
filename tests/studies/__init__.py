"""What the choices of an agent are worth, and how fast things are beside rivals."""
