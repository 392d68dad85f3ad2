"""Where results go while the service runs."""
