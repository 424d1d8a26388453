"""The impact: contacts, metric, quantities H, G, V, S, E, objectives and worst cases."""
