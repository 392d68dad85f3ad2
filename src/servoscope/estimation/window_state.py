"""Where the numbers of the recursion of windows are: of its constants, of its state, and of the rows that it writes.

A row of constants: window, levels, span, settling, number of edges, number of bands, speed of rest, rate, smoothing;
then edges [samples], b and both a of the band-pass filters.

A state: armed, sample, samples of the window, windows of the span, span, reference before, speed, 4 times the samples
since the motion began plus the motion; then filters, then sums level by level.
"""

HEADER = 8  # numbers of the state before those of the filters
ROW_HEADER = 3  # numbers of a row before the sums: sample, level, span
MAX_PHYSICAL = 1e100  # as in the recursion: no physical signal, and it would stay in the filters for ever
