"""HTTP service, command line and load test. Knows gi_core; bake_jobs where a command or a picture of errors asks for it, and only then."""
