/* Golden samples of @{prefix}.c as the bits of numbers, and the digests (FNV-1a) of its evaluations. */
#define GOLDEN_SAMPLES @{samples | length}
#define GOLDEN_EVALUATIONS @{digests | length}
static const @{bits} golden_samples[GOLDEN_SAMPLES][3] = {
@{samples | join(",\n")}};
static const unsigned char golden_restart[GOLDEN_SAMPLES] = {@{run.restart.tolist() | map("int") | items_in_lines}};
static const uint64_t golden_evaluations[] = {@{digests | items_in_lines}};
static const unsigned char golden_verdicts[] = {@{run.verdicts | items_in_lines}};
#define GOLDEN_HELD @{run.held}u
#define GOLDEN_STRETCH @{run.stretch}u
#define GOLDEN_FROZEN @{frozen}
static const unsigned char golden_image[] = {@{image | items_in_lines}};
@@ if made.covariates
#define GOLDEN_TOLERANCE @{tolerance} /* of a statistic, relative above 1 */
static const double golden_covariates[GOLDEN_SAMPLES][@{run.covariates.shape[1]}] = {
@@ for row in run.covariates.tolist()
{@{row | map("c") | join(", ")}}@{"};" if loop.last else ","}
@@ endfor
static const double golden_statistics[] = {@{run.rows.T.tolist()[1] | map("c") | items_in_lines}};
@@ endif
