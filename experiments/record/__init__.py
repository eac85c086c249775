"""Output files of a run, written and read back: journal, recordings, state, curves, summary, and its page."""
