"""A world around the service, repeatable from a seed: its time, broker, store's seam, receivers, people, and faults."""
