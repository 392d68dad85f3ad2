/* Frozen signals: y or u stays exactly the same while the motion demands a change. Of r, u, y and r - y, by index: */
#define SIGNAL_R 0
#define SIGNAL_U 1
#define SIGNAL_Y 2
#define SIGNAL_E 3
#define WINDOW @{limits.window}u /* samples */
#define EPOCH_WINDOWS @{quality.EPOCH_WINDOWS}u /* after which ranges are forgotten */

static double width(const double range[2])
{
    return range[1] - range[0];
}

static void widen(double range[2], double x)
{
    range[0] = (x < range[0]) ? x : range[0];
    range[1] = (x > range[1]) ? x : range[1];
}

/* Follow the lowest and highest value of a stretch, which begins anew where the signal has changed. */
static void track_range(double range[2], double x, int anew)
{
    if (anew != 0) {
        range[0] = x;
        range[1] = x;
    } else {
        widen(range, x);
    }
}

/* Lowest and highest value of this epoch and the one before; what is older is forgotten, and with it a spike. */
static void recent_range(const @{prefix}_signals *s, int i, double range[2])
{
    range[0] = s->ranges[0][i][0];
    range[1] = s->ranges[0][i][1];
    widen(range, s->ranges[1][i][0]);
    widen(range, s->ranges[1][i][1]);
}

/* Tell whether a signal went further than i does without moving: a share of its range, a few of its smallest changes. */
static int has_moved(const @{prefix}_signals *s, const double range[2], int i)
{
    const double steps = @{quality.MOTION_STEPS | c} * s->smallest_change[i];
    double all[2];
    double share;

    recent_range(s, i, all);
    share = @{quality.MOTION_SHARE | c} * width(all);
    return width(range) > ((share > steps) ? share : steps);
}

/* Learn, while r rests, whether y is noisy there: it turns at most samples, over many of its smallest changes. */
static void learn_rest_noise(@{prefix}_signals *s, double y, int turned)
{
    const int anew = (s->same[SIGNAL_R] % @{upper}_FROZEN_SAMPLES) == 1u;

    if (anew != 0) {
        /* the first stretch of a rest is left for the motion to settle */
        if ((s->same[SIGNAL_R] > (2u * @{upper}_FROZEN_SAMPLES)) &&
            ((double)s->turns >= (@{quality.TURN_SHARE | c} * (double)@{upper}_FROZEN_SAMPLES)) &&
            (width(s->y_at_rest) >= (@{quality.NOISE_LEVELS | c} * s->smallest_change[SIGNAL_Y]))) {
            s->noisy = 1;
        }
        s->turns = 0u;
    }
    if (turned != 0) {
        s->turns++;
    }
    track_range(s->y_at_rest, y, anew);
}

static int y_should_move(const @{prefix}_signals *s)
{
    int moved = s->noisy;

    if (moved != 0) {
        /* y cannot be that quiet */
    } else if (@{upper}_FROZEN_TRAVEL > 0.0) {
        moved = width(s->r_while_y) > @{upper}_FROZEN_TRAVEL;
    } else {
        /* a y that has never moved has no scale of its own */
        moved = has_moved(s, s->r_while_y, (s->smallest_change[SIGNAL_Y] > 0.0) ? SIGNAL_Y : SIGNAL_R);
    }
    return moved;
}

/* Tell whether a controller sets u: r is logged, and u no staircase. */
static int is_controlled(const @{prefix}_signals *s, double u)
{
    const double share = @{quality.CHANGED_SHARE | c} * ((double)s->u_samples - (double)s->same[SIGNAL_U]);
    double of_r[2];

    recent_range(s, SIGNAL_R, of_r);
    return ((double)s->u_changes >= @{quality.MIN_CHANGES | c}) && ((double)s->u_changes >= share) &&
           ((s->last[SIGNAL_R] < u) || (s->last[SIGNAL_R] > u)) && (width(of_r) > 0.0);
}

/* Count samples and changes of u since it was last the same for as long as what is frozen. */
static void count_changes_of_u(@{prefix}_signals *s, double u)
{
    const int changed = (s->started != 0) && (fabs(u - s->last[SIGNAL_U]) > 0.0);

    if ((changed != 0) && (s->same[SIGNAL_U] > @{upper}_FROZEN_SAMPLES)) {
        s->u_changes = 0u;
        s->u_samples = 0u;
    } else {
        s->u_changes += (changed != 0) ? 1u : 0u;
        s->u_samples++;
    }
}

/* Tell whether the controller has had to act; at the end of its range u is limited, and not frozen. */
static int u_should_move(const @{prefix}_signals *s, double u)
{
    const double steps = @{quality.MOTION_STEPS | c} * s->smallest_change[SIGNAL_U];
    double of_u[2];
    double of_e[2];
    double share;

    recent_range(s, SIGNAL_U, of_u);
    recent_range(s, SIGNAL_E, of_e);
    share = @{quality.MOTION_SHARE | c} * width(of_e);
    return (is_controlled(s, u) != 0) && (of_u[0] < u) && (u < of_u[1]) && (width(of_u) > steps) && (width(s->e_while_u) > share) &&
           (has_moved(s, s->y_while_u, SIGNAL_Y) != 0);
}

/* Take the values of a sample of which none is missing. */
static void take_values(@{prefix}_signals *s, const double x[4])
{
    const double step = x[SIGNAL_Y] - s->last[SIGNAL_Y];
    const int turned = (s->direction * step) < 0.0;
    int i;

    count_changes_of_u(s, x[SIGNAL_U]);
    for (i = 0; i < 4; i++) {
        if (s->started == 0) {
            track_range(s->ranges[0][i], x[i], 1);
            track_range(s->ranges[1][i], x[i], 1);
        }
        widen(s->ranges[0][i], x[i]);
    }
    for (i = 0; i < 3; i++) {
        const double change = fabs(x[i] - s->last[i]);
        const double smallest = s->smallest_change[i];

        if ((s->started == 0) || (change > 0.0)) {
            s->same[i] = 0u;
        }
        if ((s->started != 0) && (change > 0.0) && ((smallest <= 0.0) || (change < smallest))) {
            s->smallest_change[i] = change;
        }
        s->same[i]++;
        s->last[i] = x[i];
    }
    if ((step < 0.0) || (step > 0.0)) {
        s->direction = step;
    }
    s->started = 1;
    track_range(s->r_while_y, x[SIGNAL_R], s->same[SIGNAL_Y] == 1u);
    track_range(s->y_while_u, x[SIGNAL_Y], s->same[SIGNAL_U] == 1u);
    track_range(s->e_while_u, x[SIGNAL_E], s->same[SIGNAL_U] == 1u);
    learn_rest_noise(s, x[SIGNAL_Y], turned);
    if (s->same[SIGNAL_Y] == 1u) {
        s->frozen_y = 0;
    } else if ((s->frozen_y == 0) && (s->same[SIGNAL_Y] > @{upper}_FROZEN_SAMPLES)) {
        s->frozen_y = y_should_move(s);
    } else {
        /* as it was */
    }
    if (s->same[SIGNAL_U] == 1u) {
        s->frozen_u = 0;
    } else if ((s->frozen_u == 0) && (s->same[SIGNAL_U] > @{upper}_FROZEN_SAMPLES)) {
        s->frozen_u = u_should_move(s, x[SIGNAL_U]);
    } else {
        /* as it was */
    }
}

void @{prefix}_signals_init(@{prefix}_signals *signals)
{
    static const @{prefix}_signals empty = {0};

    *signals = empty;
}

int @{prefix}_frozen(@{prefix}_signals *signals, @{number} r, @{number} u, @{number} y)
{
    const double x[4] = {(double)r, (double)u, (double)y, (double)r - (double)y};
    int i;

    if ((fabs(x[0]) <= DBL_MAX) && (fabs(x[1]) <= DBL_MAX) && (fabs(x[2]) <= DBL_MAX)) {
        take_values(signals, x);
    }
    signals->samples++;
    if (((signals->samples % WINDOW) == 0u) && (signals->samples >= (EPOCH_WINDOWS * WINDOW)) &&
        (signals->started != 0)) {
        signals->samples = 0u;
        for (i = 0; i < 4; i++) {
            const double last =
                (i < SIGNAL_E) ? signals->last[i] : (signals->last[SIGNAL_R] - signals->last[SIGNAL_Y]);

            signals->ranges[1][i][0] = signals->ranges[0][i][0];
            signals->ranges[1][i][1] = signals->ranges[0][i][1];
            track_range(signals->ranges[0][i], last, 1);
        }
    }
    return ((signals->frozen_y != 0) ? @{upper}_FROZEN_Y : 0) + ((signals->frozen_u != 0) ? @{upper}_FROZEN_U : 0);
}

