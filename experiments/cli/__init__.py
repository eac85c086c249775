"""Frame of every command: command line, checked config, run folder, signals, exit status.

Every command imports this package first. Other packages import its errors, readers and writers."""
