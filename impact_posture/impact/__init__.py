"""Rigid impacts: contacts, metrics, the quantities H, G, V, S and E, objectives and worst cases."""
