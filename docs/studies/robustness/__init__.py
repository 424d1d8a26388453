"""Random variations of the shipped experiments: where does each controller help?"""
