"""Controllers: their interface (`base`), and the registry of all controllers of all signals (`registry`)."""
