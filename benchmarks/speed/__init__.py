"""What runs how fast: each module measures one thing, and says so in its first line."""
