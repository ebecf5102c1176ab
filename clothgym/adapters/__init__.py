"""Floor 8: other libraries' clothes for our environments."""
