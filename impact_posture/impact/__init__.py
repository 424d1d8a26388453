"""The impact: contacts, metric, objectives, ellipsoids and their two ways of being computed."""
