"""Environments of our own, made of robosuite's parts. Importing a module registers its environments."""
