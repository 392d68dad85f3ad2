"""Results as sentences, figures and self-contained pages."""
