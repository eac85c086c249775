"""Two species in one vial: their composition is estimated, held by the temperature, learned and compared.

A guest: it enters by what the core lets anybody add (docs/extending.md), and nobody imports it.
"""
