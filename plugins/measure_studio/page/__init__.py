"""The set-up page: what it shows, and what its buttons do."""
