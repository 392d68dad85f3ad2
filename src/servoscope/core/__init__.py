"""What every package needs: errors, settings, files, arrays, compiled kernels; it knows nothing of loops."""
