"""Examples of extensions, which tests load with `extend=`."""
