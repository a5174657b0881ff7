"""Recording an experiment: a plan, the stage and the sensor that carry it out, and files that survive the program."""
