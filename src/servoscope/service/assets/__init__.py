"""One asset and many: their states, what is kept of their samples, their examinations and their alarms."""
