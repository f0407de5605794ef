"""HTTP service, command line and load test. Knows gi_core; never bake_jobs (the command line imports that lazily)."""
