"""What a robot is: its model, named postures, limits, armature and actuation."""
