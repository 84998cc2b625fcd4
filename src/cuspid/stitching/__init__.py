"""Frames of one hand-held camera to one picture of the arch (chapter 4 of the thesis)."""
