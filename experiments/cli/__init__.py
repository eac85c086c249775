"""From a command line to a checked config and a run folder; how a command ends.

Commands enter here first. Rooms take `UserError` from here. Imports of ours: conf, the atomic writer, tables."""
