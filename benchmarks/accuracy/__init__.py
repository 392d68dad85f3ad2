"""How accurate servoscope is: bias, coverage, false alarms and delays, by repeated simulation."""
