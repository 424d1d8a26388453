"""The world in which controllers are compared: a robot in MuJoCo, what it touches, its rotors, motors and sensors."""
