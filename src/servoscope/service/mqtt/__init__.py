"""Blocks over MQTT: their payloads, the source that takes them, the publisher that sends them, results sent back."""
