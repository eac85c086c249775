"""What must survive a power cut: journal, recordings, atomic files; and reading recordings of others.

Entered by the record of a run, by resume, by calibrate, and by whatever writes a file that must be whole."""
