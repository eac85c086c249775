"""What must survive a power cut: journal, recordings, atomic files.

Entered by the record of a run, by resume, and by whatever writes a file that must be whole."""
