"""Files that must survive a power cut: journal, recordings, atomic files.

The record of a run, a resume, and all code that writes a file atomically use it."""
