"""What people look at: charts, tables, pages, TensorBoard. Arrays and dictionaries in, files out.

Entered by commands and by every room above; imports no other room of the experiments."""
