"""Device sweeps: the only room with `@wp.kernel` and `wp.launch`. Physics is in `laws`."""
