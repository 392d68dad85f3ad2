"""Work that takes seconds, outside the server's process: a queue, its worker, its tasks."""
