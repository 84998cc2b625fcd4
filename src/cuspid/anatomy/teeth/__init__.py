"""The teeth of a textbook: shapes of their crowns, and how they stand in the arch."""
