"""Record an experiment: run a test plan on a stage and a force sensor, and keep the files after a crash."""
