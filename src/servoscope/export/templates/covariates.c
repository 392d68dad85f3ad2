/* covariates: x = (average - middle) / half, and its powers; they move theta by slopes, or their logarithms */
#define POWERS @{made.covariates.model.slopes | length}
#define KEEP @{made.covariates.average.keep | c} /* of an average, per sample */
#define VALUES AT_COVARIATES
#define AVERAGES (VALUES + @{upper}_COVARIATES) /* 2 each; the second stays 0, as in the program on the server */
#define AGES (AVERAGES + (2 * @{upper}_COVARIATES))

static const double known_range[@{upper}_COVARIATES][2] = {
@{tables.known_range | table}
};
static const double learned[@{upper}_COVARIATES][2] = { /* middle, half */
@{tables.learned | table}
};
static const int degrees[@{upper}_COVARIATES] = {@{made.covariates.model.degrees | join(", ")}};
static const int proportional[@{upper}_COEFFICIENTS] = {@{made.covariates.model.proportional | map("int") | join(", ")}};
static const double slopes[POWERS][@{upper}_COEFFICIENTS] = {
@{tables.slopes | table}
};
static const double slope_covariance[POWERS * @{upper}_COEFFICIENTS][POWERS * @{upper}_COEFFICIENTS] = {
@{tables.slope_covariance | table}
};
static const double theta_middle[@{upper}_COEFFICIENTS] = {@{tables.theta_middle.tolist() | map("c") | join(", ")}};
static const double theta_expected[@{upper}_COEFFICIENTS] = {@{tables.theta_expected.tolist() | map("c") | join(", ")}}; /* without the bias of the regression */
static const double theta_origin[@{upper}_COEFFICIENTS] = {@{tables.theta_origin.tolist() | map("c") | join(", ")}};
static const double to_state[@{upper}_COEFFICIENTS][@{upper}_COEFFICIENTS] = {
@{tables.to_state | table}
};
static const double to_response[2 * @{upper}_FREQUENCIES][@{upper}_COEFFICIENTS] = {
@{tables.to_response | table}
};

void @{prefix}_covariates(@{prefix}_state *state, const double values[@{upper}_COVARIATES])
{
    size_t j;

    for (j = 0; j < @{upper}_COVARIATES; j++) {
        if (fabs(values[j]) <= DBL_MAX) {
            state->numbers[VALUES + j] = values[j];
            state->numbers[AGES + j] = -1.0;
        }
    }
}

/* Write the powers of covariates, and the healthy coefficients there. */
static void move_coefficients(const double *c, double *powers, double *theta)
{
    int p = 0;
    int d;
    size_t i;
    size_t j;

    for (j = 0; j < @{upper}_COVARIATES; j++) {
        const double held = (c[j] < known_range[j][0]) ? known_range[j][0] : c[j];
        const double x = (((held > known_range[j][1]) ? known_range[j][1] : held) - learned[j][0]) / learned[j][1];
        double power = 1.0;

        for (d = 0; d < degrees[j]; d++) {
            power = power * x;
            powers[p] = power;
            p++;
        }
    }
    for (i = 0; i < @{upper}_COEFFICIENTS; i++) {
        double g = 0.0;

        for (p = 0; p < POWERS; p++) {
            g = g + (powers[p] * slopes[p][i]);
        }
        theta[i] = (proportional[i] != 0) ? (theta_middle[i] * exp(g)) : (theta_middle[i] + g);
    }
}

/* Take the covariates of a sample into their averages; return whether all are known. The first time, theta begins there. */
static int follow_covariates(@{prefix}_state *state, double *average)
{
    double *s = state->numbers;
    double powers[POWERS];
    double theta[@{upper}_COEFFICIENTS];
    int known = 1;
    int began = 1;
    size_t i;
    size_t j;

    for (j = 0; j < @{upper}_COVARIATES; j++) {
        double *memory = &s[AVERAGES + (2u * j)];

        s[AGES + j] = s[AGES + j] + 1.0;
        if (!(fabs(memory[0]) <= DBL_MAX)) {
            began = 0;
            if (fabs(s[VALUES + j]) <= DBL_MAX) {
                memory[0] = KEEP * s[VALUES + j];
                memory[1] = 0.0;
            }
        }
        average[j] = ((1.0 - KEEP) * s[VALUES + j]) + memory[0];
        if (fabs(average[j]) <= DBL_MAX) {
            memory[0] = KEEP * average[j];
        }
        if (!(fabs(average[j]) <= DBL_MAX) || (s[AGES + j] > @{upper}_COVARIATE_HOLD)) {
            known = 0;
        }
    }
    if ((began == 0) && (known != 0)) {
        move_coefficients(average, powers, theta);
        for (i = 0; i < @{upper}_COEFFICIENTS; i++) {
            s[AT_THETA + i] = 0.0;
            for (j = 0; j < @{upper}_COEFFICIENTS; j++) {
                s[AT_THETA + i] = s[AT_THETA + i] + (to_state[i][j] * (theta[j] - theta_origin[j]));
            }
        }
    }
    return known;
}

/* Return d' C^-1 d by Cholesky's factor of C, whose units are evened out first. */
static double squared_distance(const double *C, const double *d)
{
    double L[@{upper}_COEFFICIENTS][@{upper}_COEFFICIENTS];
    double white[@{upper}_COEFFICIENTS];
    double size[@{upper}_COEFFICIENTS];
    double total = 0.0;
    size_t i;
    size_t j;
    size_t k;

    for (i = 0; i < @{upper}_COEFFICIENTS; i++) {
        double rest;

        size[i] = sqrt(C[(i * @{upper}_COEFFICIENTS) + i]);
        rest = d[i] / size[i];
        for (j = 0; j <= i; j++) {
            double sum = (C[(i * @{upper}_COEFFICIENTS) + j] / size[i]) / size[j];

            for (k = 0; k < j; k++) {
                sum = sum - (L[i][k] * L[j][k]);
            }
            L[i][j] = (i == j) ? sqrt(sum) : (sum / L[j][j]);
        }
        for (k = 0; k < i; k++) {
            rest = rest - (L[i][k] * white[k]);
        }
        white[i] = rest / L[i][i];
        total = total + (white[i] * white[i]);
    }
    return total;
}

/* Compare an evaluation with what is healthy at averages of the covariates. */
static void compare_covariates(const double *average, int known, @{prefix}_evaluation *q)
{
    double powers[POWERS];
    double theta[@{upper}_COEFFICIENTS];
    double d[@{upper}_COEFFICIENTS];
    size_t i;
    size_t j;
    size_t k;
    size_t p;

    q->place = (known != 0) ? @{upper}_KNOWN : @{upper}_UNKNOWN;
    for (j = 0; j < @{upper}_COVARIATES; j++) {
        if ((known != 0) && !((average[j] >= known_range[j][0]) && (average[j] <= known_range[j][1]))) {
            q->place = @{upper}_OUTSIDE;
        }
    }
    q->statistic = 0.0;
    if (q->place == @{upper}_KNOWN) {
        move_coefficients(average, powers, theta);
        for (i = 0; i < @{upper}_COEFFICIENTS; i++) {
            d[i] = q->theta[i] - (theta_expected[i] + (theta[i] - theta_middle[i]));
            for (j = 0; j < @{upper}_COEFFICIENTS; j++) {
                double more = 0.0;

                for (p = 0; p < POWERS; p++) {
                    for (k = 0; k < POWERS; k++) {
                        more = more + ((powers[p] * slope_covariance[(p * @{upper}_COEFFICIENTS) + i]
                                                                    [(k * @{upper}_COEFFICIENTS) + j]) * powers[k]);
                    }
                }
                more = more * ((proportional[i] != 0) ? theta[i] : 1.0) * ((proportional[j] != 0) ? theta[j] : 1.0);
                q->covariance[(i * @{upper}_COEFFICIENTS) + j] = q->covariance[(i * @{upper}_COEFFICIENTS) + j] + more;
            }
        }
        q->statistic = (q->updates > 0.0) ? squared_distance(q->covariance, d) : 0.0;
        for (k = 0; k < @{upper}_FREQUENCIES; k++) {
            for (i = 0; i < @{upper}_COEFFICIENTS; i++) {
                const double moved = theta[i] - theta_middle[i];

                q->gamma[k].real = q->gamma[k].real - (to_response[2u * k][i] * moved);
                q->gamma[k].imag = q->gamma[k].imag - (to_response[(2u * k) + 1u][i] * moved);
            }
        }
    }
}

