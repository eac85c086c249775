"""Bugs planted by hand, and which of them the tests noticed (docs/records/mutation.md)."""
