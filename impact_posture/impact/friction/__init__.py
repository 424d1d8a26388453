"""Coulomb friction at the contact and at the feet."""
