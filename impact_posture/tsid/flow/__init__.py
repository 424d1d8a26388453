"""The reference flow to postures with lower impacts."""
