"""Turns images into tracks: keypoints, pairs, matches, the motion from frame to frame, places that are seen again."""
