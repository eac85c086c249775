"""What a run leaves behind, and reads back: journal, recordings, state, curves, summary, the page after it."""
