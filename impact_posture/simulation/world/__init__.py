"""The MuJoCo world: scene, rotors, sensors, contact forces."""
