"""The operator's console: `truecell`. It holds no state; the daemon owns the work."""
