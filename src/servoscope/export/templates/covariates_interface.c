/* Covariates: what a healthy loop shows moves with them. */
#define @{upper}_COVARIATES @{made.covariates.model.names | length} /* @{made.covariates.model.names | join(", ") | plain} */
#define @{upper}_COVARIATE_HOLD @{made.covariates.hold | c} /* samples for which a value holds without a new one */

typedef enum {
    @{upper}_KNOWN = 0,
    @{upper}_UNKNOWN = 1, /* one has had no value, or none for too long: the estimate is held */
    @{upper}_OUTSIDE = 2  /* one is outside of what the healthy recordings hold: no verdict is given */
} @{prefix}_place;

