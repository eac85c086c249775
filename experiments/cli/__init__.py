"""From a command line to a checked config and a run folder; how a command ends.

Commands enter here first. Rooms take `UserError` and the atomic writer from here. Imports nothing of ours but conf."""
