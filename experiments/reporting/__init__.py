"""Charts, tables, pages, TensorBoard: files from arrays and dictionaries.

Commands and other packages import it. Of the packages in experiments/ it imports only `experiments.cli`."""
