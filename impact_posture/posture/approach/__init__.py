"""The speed at which the joints can bring the contact to the surface."""
