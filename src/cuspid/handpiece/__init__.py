"""What scans the jaw: designs of handpieces, and what their cameras can see."""
