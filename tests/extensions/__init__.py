"""Files of one's own that tests load with `extend=`."""
