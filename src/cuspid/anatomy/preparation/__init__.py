"""Teeth prepared by the dentist: cracks, crowns and inlays cut into a jaw."""
