"""What several cases of the folder `speed` use: limits of the machine, other libraries, slow doubles, senders."""
