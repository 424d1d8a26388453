"""Simulation of controllers in a world: a robot in MuJoCo, its surroundings, rotors, motors and sensors."""
