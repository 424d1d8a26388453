"""The reference flow, which moves the reference posture to postures with lower impacts."""
