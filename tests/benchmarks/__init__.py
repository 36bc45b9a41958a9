"""Speed against others, and what they compute; ``tests`` sets one thread for linear algebra."""
