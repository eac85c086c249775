"""Charts, tables, pages, TensorBoard: files from arrays and dictionaries.

Commands and other rooms import it; it imports no other room of the experiments."""
