"""Charts, tables, pages, TensorBoard: files from arrays and dictionaries.

Commands and other packages import it; it imports only `experiments.cli` of the experiments."""
