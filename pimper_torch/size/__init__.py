"""The real size of a result: from lengths that are known, and markers that were printed."""
