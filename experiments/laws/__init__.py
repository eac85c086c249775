"""What decides: what a law is asked (`base`), and every law of every signal by its name (`registry`)."""
