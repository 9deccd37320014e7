"""Device physics: `@wp.func` formulas, one law per file, made once per precision."""
