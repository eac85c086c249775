"""What people look at: charts, tables, pages, TensorBoard. Arrays and dictionaries in, files out.

Entered by everybody above; imports of ours only `experiments.cli`."""
