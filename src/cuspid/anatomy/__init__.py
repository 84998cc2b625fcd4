"""What is scanned: the mouth, the jaw and its teeth."""
