"""Coulomb friction at the contact and under the feet."""
