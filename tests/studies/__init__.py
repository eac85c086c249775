"""What the choices of an agent are worth, why a plain one gets worse late, and how fast things are beside rivals."""
