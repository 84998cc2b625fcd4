"""Poses from measured surfaces, for teeth without texture: how they lie on each other."""
