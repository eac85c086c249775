"""From a command line to a checked config and a run folder; how a command ends.

Commands import this room first; other rooms import `UserError`. It imports conf, the atomic writer and tables."""
