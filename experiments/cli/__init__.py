"""Frame of every command: command line, checked config, run folder, signals, exit status.

Every command imports this package first. Other packages import files and errors from it."""
