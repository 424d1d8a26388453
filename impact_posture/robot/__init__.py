"""Robot descriptions: model, named postures, limits, armature and actuation."""
