"""What is compared: every law that turns readings into pump rates, batch first, free of torch and files.

Entered through `registry`, by whatever closes a loop."""
