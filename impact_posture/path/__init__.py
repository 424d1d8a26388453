"""A path from the start to the optimum that the robot can take, and the time that it takes."""
