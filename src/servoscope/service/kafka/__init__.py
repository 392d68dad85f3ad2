"""Kafka: a plant's messages as blocks."""
