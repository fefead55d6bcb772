/* The step of the instrument in C, by hand: the yardstick of the limit for benchmarks/step.py.

   Same mathematics, same memory: layout.h is written from the numpy dtypes of the firmware's records, so both run on
   the same states. Only the regular way through the step is here (aligned, no gap, finite readings, reachable tip,
   methods error-state and adaptive); instrument_step() returns nonzero when a tick would leave it. */

#include <math.h>
#include <string.h>
#include "layout.h"

#define N 13 /* errors of the attitude filter: turn, rate, bias, velocity, disturbance */
enum { TURN = 0, RATE_ = 3, BIAS = 6, VELOCITY = 9, DISTURBANCE = 12 };
static const double PI = 3.14159265358979323846;

typedef sense_state_attitude Attitude;
typedef sense_params_attitude_error_state ErrorParams;
typedef sense_state_attitude_error_state Errors;

/* ---- sensing ------------------------------------------------------------------------------------------ */

static int calibrate(double *f, double *smoothed, const sense_params_calibration *p, int *bits)
{
    for (int i = 0; i < 8; i++) {
        f[VOLTS + i] = f[COUNTS + i] * p->lsb_V;
        if (!isfinite(f[VOLTS + i])) return 1;
    }
    double supply = f[VOLTS + p->supply_channel] * p->supply_divider;
    if (supply < 0.2 * p->nominal_supply_V || isnan(smoothed[0])) return 1;
    double warm = (f[VOLTS + p->temperature_channel] - p->temperature_offset_V) * p->temperature_C_per_V;
    smoothed[0] += p->supply_smoothing * (supply - smoothed[0]);
    smoothed[1] += p->temperature_smoothing * (warm - smoothed[1]);
    f[SUPPLY] = smoothed[0];
    f[TEMPERATURE] = smoothed[1];
    double ratio = p->nominal_supply_V / smoothed[0], rise = smoothed[1] - p->reference_C, line[6];
    for (int i = 0; i < 6; i++) {
        double volts = f[VOLTS + p->channel[i]] * ratio - p->bias_V[i] - p->bias_V_per_C[i] * rise;
        line[i] = volts / (p->scale_V[i] * (1.0 + p->scale_per_C[i] * rise));
        if (fabs(line[i]) > p->range) *bits = SATURATED;
    }
    for (int i = 0; i < 6; i++) {
        double y = line[p->in_plane[i]], z = line[p->out_of_plane[i]];
        const double *g = p->bias_in_plane[i], *h = p->bias_out_of_plane[i], *r = p->scale_out_of_plane[i];
        double bias = y * (g[0] + g[1] * y) + z * (h[0] + h[1] * z);
        f[ACCELEROMETER + i] = (line[i] - bias) / (1.0 + z * (r[0] + r[1] * z));
    }
    return 0;
}

static void solve_motion(const double *y, const double *w, const sense_params_kinematics *p, double *out)
{
    double square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
    for (int k = 0; k < 6; k++) out[k] = 0.0;
    for (int i = 0; i < 6; i++) {
        const double *r = p->positions[i], *s = p->axes[i];
        double along = w[0] * r[0] + w[1] * r[1] + w[2] * r[2];
        double tangential = y[i] - (s[0] * (w[0] * along - r[0] * square) + s[1] * (w[1] * along - r[1] * square)
                                    + s[2] * (w[2] * along - r[2] * square));
        for (int k = 0; k < 6; k++) out[k] += p->solve[k][i] * tangential;
    }
}

static void point_force(const double *m, const double *bias, const double *w, const double *r, double *out)
{
    double ax = m[3] - bias[0], ay = m[4] - bias[1], az = m[5] - bias[2];
    double along = w[0] * r[0] + w[1] * r[1] + w[2] * r[2], square = w[0] * w[0] + w[1] * w[1] + w[2] * w[2];
    out[0] = m[0] + ay * r[2] - az * r[1] + w[0] * along - r[0] * square;
    out[1] = m[1] + az * r[0] - ax * r[2] + w[1] * along - r[1] * square;
    out[2] = m[2] + ax * r[1] - ay * r[0] + w[2] * along - r[2] * square;
}

static void rotate_by(double *q, double x, double y, double z)
{
    double angle2 = x * x + y * y + z * z, scale, c;
    if (angle2 < 1e-12) {
        scale = 0.5 - angle2 / 48.0;
        c = 1.0 - angle2 / 8.0;
    } else {
        double angle = sqrt(angle2);
        scale = sin(0.5 * angle) / angle;
        c = cos(0.5 * angle);
    }
    x *= scale, y *= scale, z *= scale;
    double w0 = q[0], x0 = q[1], y0 = q[2], z0 = q[3];
    q[0] = w0 * c - x0 * x - y0 * y - z0 * z;
    q[1] = w0 * x + x0 * c + y0 * z - z0 * y;
    q[2] = w0 * y - x0 * z + y0 * c + z0 * x;
    q[3] = w0 * z + x0 * y - y0 * x + z0 * c;
    double norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    if (q[0] < 0.0) norm = -norm;
    for (int i = 0; i < 4; i++) q[i] /= norm;
}

static void to_matrix(const double *q, double (*c)[3])
{
    double w = q[0], x = q[1], y = q[2], z = q[3];
    c[0][0] = w * w + x * x - y * y - z * z;
    c[0][1] = 2.0 * (x * y - w * z);
    c[0][2] = 2.0 * (x * z + w * y);
    c[1][0] = 2.0 * (x * y + w * z);
    c[1][1] = w * w - x * x + y * y - z * z;
    c[1][2] = 2.0 * (y * z - w * x);
    c[2][0] = 2.0 * (x * z - w * y);
    c[2][1] = 2.0 * (y * z + w * x);
    c[2][2] = w * w - x * x - y * y + z * z;
}

static void propagate(Errors *e, const ErrorParams *a, double (*c)[3], const double *up, const double *rate, double dt)
{
    double(*p)[N] = e->covariance, w[N][N], fade = exp(-dt / a->disturbance_s);
    for (int j = 0; j < N; j++) { /* W = F P, row by row of F */
        for (int k = 0; k < 3; k++) {
            w[TURN + k][j] = p[TURN + k][j] + dt * (c[k][0] * p[RATE_][j] + c[k][1] * p[RATE_ + 1][j] + c[k][2] * p[RATE_ + 2][j]);
            w[RATE_ + k][j] = p[RATE_ + k][j] - dt * p[BIAS + k][j];
            w[BIAS + k][j] = p[BIAS + k][j];
        }
        double x = p[0][j], y = p[1][j], z = p[2][j];
        w[VELOCITY][j] = p[VELOCITY][j] + dt * (y * up[2] - z * up[1]);
        w[VELOCITY + 1][j] = p[VELOCITY + 1][j] + dt * (z * up[0] - x * up[2]);
        w[VELOCITY + 2][j] = p[VELOCITY + 2][j] + dt * (x * up[1] - y * up[0]);
        w[DISTURBANCE][j] = fade * p[DISTURBANCE][j];
    }
    for (int i = 0; i < N; i++) { /* P = W F^T */
        for (int k = 0; k < 3; k++) {
            p[i][TURN + k] = w[i][TURN + k] + dt * (c[k][0] * w[i][RATE_] + c[k][1] * w[i][RATE_ + 1] + c[k][2] * w[i][RATE_ + 2]);
            p[i][RATE_ + k] = w[i][RATE_ + k] - dt * w[i][BIAS + k];
            p[i][BIAS + k] = w[i][BIAS + k];
        }
        double x = w[i][0], y = w[i][1], z = w[i][2];
        p[i][VELOCITY] = w[i][VELOCITY] + dt * (y * up[2] - z * up[1]);
        p[i][VELOCITY + 1] = w[i][VELOCITY + 1] + dt * (z * up[0] - x * up[2]);
        p[i][VELOCITY + 2] = w[i][VELOCITY + 2] + dt * (x * up[1] - y * up[0]);
        p[i][DISTURBANCE] = fade * w[i][DISTURBANCE];
    }
    double spin = a->turn_per_rate * (rate[0] * rate[0] + rate[1] * rate[1] + rate[2] * rate[2]);
    for (int i = 0; i < 3; i++) {
        for (int k = 0; k < 3; k++) {
            double turned = 0.0;
            for (int n = 0; n < 3; n++) turned += c[i][n] * a->turn_density[n] * c[k][n];
            p[TURN + i][TURN + k] += turned * dt;
        }
        p[TURN + i][TURN + i] += spin * dt;
        p[RATE_ + i][RATE_ + i] += a->rate_density[i] * dt;
        p[BIAS + i][BIAS + i] += a->bias_density[i] * dt;
        p[VELOCITY + i][VELOCITY + i] += a->force_density * dt;
    }
    p[DISTURBANCE][DISTURBANCE] += a->disturbance_rad * a->disturbance_rad * (1.0 - fade * fade);
}

static int correct(Errors *e, int first, int second, double residual, double variance, double gate, double lean,
                   double *gain)
{
    double(*p)[N] = e->covariance, column[N];
    for (int i = 0; i < N; i++) /* P is symmetric */
        column[i] = p[first][i] + lean * p[TURN][i] - (second >= 0 ? p[second][i] : 0.0);
    double innovation = column[first] + lean * column[TURN] + variance, rest = residual - gain[first] - lean * gain[TURN];
    if (second >= 0) {
        innovation -= column[second];
        rest += gain[second];
    }
    if (rest * rest > gate * gate * innovation) return 0;
    for (int i = 0; i < N; i++) {
        column[i] /= innovation;
        gain[i] += column[i] * rest;
    }
    for (int i = 0; i < N; i++)
        for (int j = 0; j < N; j++) p[i][j] -= innovation * column[i] * column[j];
    return 1;
}

static void forget_velocity(Errors *e)
{
    for (int k = VELOCITY; k < VELOCITY + 3; k++) {
        for (int j = 0; j < N; j++) e->covariance[k][j] = e->covariance[j][k] = 0.0;
        e->covariance[k][k] = e->velocity[k - VELOCITY] * e->velocity[k - VELOCITY] + 1e-6;
        e->velocity[k - VELOCITY] = e->notch[k - VELOCITY][0] = e->notch[k - VELOCITY][1] = 0.0;
    }
    e->moving_s = 0.0;
}

static int heading(Attitude *s, const ErrorParams *a, const double *b, double *x)
{
    Errors *e = &s->error_state;
    double(*c)[3] = s->matrix, since = e->field_fresh_s;
    double north = c[0][0] * b[0] + c[0][1] * b[1] + c[0][2] * b[2];
    double west = c[1][0] * b[0] + c[1][1] * b[1] + c[1][2] * b[2];
    double up = c[2][0] * b[0] + c[2][1] * b[1] + c[2][2] * b[2];
    double level = sqrt(north * north + west * west), size = sqrt(level * level + up * up);
    if (size == 0.0 || level < 0.02 * size) return 0;
    double dip = atan2(-up, level);
    if (e->field_size == 0.0) e->field_size = size, e->field_dip = dip;
    int known = fabs(size - e->field_size) < a->field_tolerance * e->field_size && fabs(dip - e->field_dip) < a->dip_tolerance_rad;
    if (!known) return 1;
    e->regained_s += since;
    if (e->regained_s < 0.5) return 0;
    double learn = since / 5.0 < 1.0 ? since / 5.0 : 1.0;
    e->field_size += learn * (size - e->field_size);
    e->field_dip += learn * (dip - e->field_dip);
    e->field_wait_s = e->candidate_s = 0.0;
    for (int i = 0; i < 3; i++) e->trusted[i] = b[i];
    correct(e, TURN + 2, DISTURBANCE, e->disturbance - atan2(west, north), a->heading_density / since, 1e9,
            a->heading_tilts ? -up / level : 0.0, x);
    return 0;
}

static int attitude(Attitude *s, const sense_params_attitude *p, const double *force, const double *alpha,
                    const double *field, int fresh)
{
    const ErrorParams *a = &p->error_state;
    Errors *e = &s->error_state;
    double dt = p->dt_s, turn[3], up[3], x[N] = {0.0};
    double(*c)[3] = s->matrix;
    if (fresh) memcpy(s->field, field, 3 * sizeof(double));
    s->time_s += dt;
    for (int i = 0; i < 3; i++) {
        double now = alpha[i] - s->bias[i], before = s->rate[i];
        s->rate[i] += 0.5 * (now + s->previous[i]) * dt;
        s->previous[i] = now;
        turn[i] = (before + a->lead * (s->rate[i] - before)) * dt;
    }
    rotate_by(s->quaternion, turn[0], turn[1], turn[2]);
    to_matrix(s->quaternion, c);
    for (int i = 0; i < 3; i++) {
        up[i] = c[i][0] * force[0] + c[i][1] * force[1] + c[i][2] * force[2];
        e->velocity[i] += up[i] * dt;
    }
    e->velocity[2] -= a->gravity * dt;
    e->disturbance *= exp(-dt / a->disturbance_s);
    propagate(e, a, c, up, s->rate, dt);
    if (a->rest_density > 0.0) return 1;
    double gate = a->velocity_gate > 0.0 ? a->velocity_gate : 1e9;
    int moving = 0;
    for (int i = 0; i < 3; i++) {
        double seen = a->notch[0] * e->velocity[i] + e->notch[i][0];
        e->notch[i][0] = a->notch[1] * e->velocity[i] - a->notch[3] * seen + e->notch[i][1];
        e->notch[i][1] = a->notch[2] * e->velocity[i] - a->notch[4] * seen;
        double density = a->still_density;
        if (a->swing_s > 0.0) {
            double fast = seen - e->sway[i], share = dt / a->swing_mean_s;
            e->sway[i] += (dt / 0.3 < 1.0 ? dt / 0.3 : 1.0) * fast;
            e->swing[i] += (share < 1.0 ? share : 1.0) * (fast * fast - e->swing[i]);
            double more = e->swing[i] - e->covariance[VELOCITY + i][VELOCITY + i];
            density += a->swing_s * (more > 0.0 ? more : 0.0);
        }
        moving |= !correct(e, VELOCITY + i, -1, -seen, density / dt, gate, 0.0, x);
    }
    if (moving) {
        e->gated += 1;
        e->moving_s += dt;
        if (e->moving_s > a->moving_s) forget_velocity(e);
    } else
        e->moving_s = 0.0;
    e->field_fresh_s += dt;
    e->field_wait_s += dt;
    if (fresh) {
        if (heading(s, a, field, x)) return 1;
        e->field_fresh_s = 0.0;
    }
    if (a->held_density > 0.0 && e->field_wait_s > 0.2) {
        double *b = e->trusted;
        double north = c[0][0] * b[0] + c[0][1] * b[1] + c[0][2] * b[2];
        double west = c[1][0] * b[0] + c[1][1] * b[1] + c[1][2] * b[2];
        correct(e, TURN + 2, -1, -atan2(west, north), a->held_density / dt, 1e9, 0.0, x);
    }
    double tx = c[0][0] * x[0] + c[1][0] * x[1] + c[2][0] * x[2];
    double ty = c[0][1] * x[0] + c[1][1] * x[1] + c[2][1] * x[2];
    double tz = c[0][2] * x[0] + c[1][2] * x[1] + c[2][2] * x[2];
    rotate_by(s->quaternion, tx, ty, tz);
    to_matrix(s->quaternion, c);
    s->corrected[0][0] = tx, s->corrected[0][1] = ty, s->corrected[0][2] = tz;
    for (int i = 0; i < 3; i++) {
        s->corrected[1][i] = x[RATE_ + i];
        s->corrected[2][i] += x[BIAS + i];
        s->rate[i] += x[RATE_ + i];
        s->bias[i] += x[BIAS + i];
        e->velocity[i] += x[VELOCITY + i];
    }
    e->disturbance += x[DISTURBANCE];
    return 0;
}

static void integrate_band(const double *in, double (*memory)[2][2], const double (*b)[5], double *out)
{
    for (int i = 0; i < 3; i++) {
        double x = in[i];
        for (int j = 0; j < 2; j++) {
            double y = b[j][0] * x + memory[i][j][0];
            memory[i][j][0] = b[j][1] * x - b[j][3] * y + memory[i][j][1];
            memory[i][j][1] = b[j][2] * x - b[j][4] * y;
            x = y;
        }
        out[i] = x;
    }
}

static int sense(double *f, sense_state *s, const sense_params *p)
{
    int bits = 0;
    Attitude *a = &s->attitude;
    if (calibrate(f, s->smoothed, &p->calibration, &bits)) return 1;
    if (f[TICK] - s->last_tick != 1.0 || !a->aligned) return 1;
    s->last_tick = f[TICK];
    int fresh = f[MAGNETOMETER_FRESH] != 0.0;
    if (fresh)
        for (int i = 0; i < 3; i++) {
            double field = 0.0;
            for (int j = 0; j < 3; j++)
                field += p->calibration.magnetometer_uT_per_V[i][j] * (f[MAGNETOMETER_RAW + j] - p->calibration.magnetometer_bias_V[j]);
            f[MAGNETOMETER + i] = field;
        }
    solve_motion(f + ACCELEROMETER, a->rate, &p->kinematics, s->motion);
    double felt[3];
    point_force(s->motion, a->bias, a->rate, p->quiet_point, felt);
    if (attitude(a, &p->attitude, felt, s->motion + 3, f + MAGNETOMETER, fresh)) return 1;
    double sudden[3], turn[3], dt = p->attitude.dt_s;
    double(*corrected)[3] = a->corrected;
    for (int i = 0; i < 3; i++) {
        sudden[i] = (corrected[0][i] - s->turned[i]) / (dt * dt) + corrected[1][i] / dt - corrected[2][i];
        s->turned[i] = corrected[0][i];
    }
    integrate_band(sudden, s->lean, p->lean_sections, turn);
    const double *z = a->matrix[2];
    double up[3] = {z[0] + turn[1] * z[2] - turn[2] * z[1], z[1] + turn[2] * z[0] - turn[0] * z[2],
                    z[2] + turn[0] * z[1] - turn[1] * z[0]};
    double *tip = f + TIP_ACCELERATION;
    point_force(s->motion, a->bias, a->rate, p->translation.tip_m, tip);
    for (int i = 0; i < 3; i++) tip[i] -= p->translation.gravity * up[i];
    integrate_band(tip, s->memory, p->translation.sections, f + TIP_DISPLACEMENT);
    for (int i = 0; i < 3; i++) {
        f[SPECIFIC_FORCE + i] = s->motion[i];
        f[ANGULAR_ACCELERATION + i] = s->motion[3 + i] - a->bias[i];
        f[RATE + i] = a->rate[i];
    }
    for (int i = 0; i < 4; i++) f[QUATERNION + i] = a->quaternion[i];
    f[STATUS] = (int)f[STATUS] | bits;
    return 0;
}

/* ---- tremor ------------------------------------------------------------------------------------------- */

typedef estimate_params_adaptive Filter;
typedef estimate_state_adaptive Adaptive;
#define BANK ((int)(sizeof(((Filter *)0)->onward[0][0]) / sizeof(double)))
#define CHANNELS ((int)(sizeof(((Filter *)0)->onward[0]) / sizeof(((Filter *)0)->onward[0][0])))
#define ONE (BANK / CHANNELS)
#define POLES ((int)(sizeof(((Filter *)0)->pole_re) / sizeof(double)))
#define SLOW ((int)(sizeof(((Filter *)0)->slow) / sizeof(double)))
#define TAPS_ ((int)(sizeof(((Filter *)0)->taps) / sizeof(double) / OUTPUTS))
#define LAG (TAPS_ / 2)
#define OUTPUTS 3 /* now, ahead, core */
#define LEVELS 2

static void bank_turn(double *bank, const Filter *p)
{
    for (double *b = bank; b < bank + BANK; b += ONE) {
        for (int r = 0; r < POLES; r++) {
            double re = b[2 * r], im = b[2 * r + 1];
            b[2 * r] = p->pole_re[r] * re - p->pole_im[r] * im;
            b[2 * r + 1] = p->pole_re[r] * im + p->pole_im[r] * re;
        }
        for (int r = 0; r < SLOW; r++) b[2 * POLES + r] *= p->slow[r];
        b[ONE - 1] = 0.0;
    }
}

static void bank_add(double *bank, int channel, double sample, const Filter *p)
{
    double *b = bank + channel * ONE;
    for (int r = 0; r < POLES; r++) b[2 * r] += p->pole_gain[r] * sample;
    for (int r = 0; r < SLOW; r++) b[2 * POLES + r] += (1.0 - p->slow[r]) * sample;
    b[ONE - 1] += sample;
}

static void regress(Adaptive *s, int axis, int at, const Filter *p)
{
    double target[OUTPUTS] = {0.0}, keep = p->keep;
    for (int j = 0; j < TAPS_; j++) {
        double block = s->blocks[axis][(at - j) % TAPS_];
        for (int o = 0; o < OUTPUTS; o++) target[o] += p->taps[o][j] * block;
    }
    double now2 = target[0] * target[0], burst = s->bursts[axis][(at - LAG) % (LAG + 1)];
    const double *phi = s->snapshots[axis][(at - LAG) % (LAG + 1)];
    for (int l = 0; l < LEVELS; l++) {
        double n0 = p->prior_blocks[l];
        double typical = (n0 * p->weighted_power[l] + s->power[axis][l]) / (n0 + s->count[axis][l]);
        double weight = p->outlier * typical / (now2 > 1e-300 ? now2 : 1e-300);
        weight = (l ? burst : 1.0 - burst) * (weight < 1.0 ? weight : 1.0);
        s->count[axis][l] = keep * s->count[axis][l] + weight;
        s->power[axis][l] = keep * s->power[axis][l] + weight * now2;
        for (int i = 0; i < BANK; i++) {
            double scaled = weight * phi[i], *row = s->normal[axis][l][i];
            for (int j = 0; j <= i; j++) row[j] = keep * row[j] + scaled * phi[j];
            for (int o = 0; o < OUTPUTS; o++) s->right[axis][l][o][i] = keep * s->right[axis][l][o][i] + scaled * target[o];
        }
    }
}

static void know_noise(Adaptive *s, const Filter *p)
{
    int one = BANK / CHANNELS;
    for (int i = 0; i < 3; i++)
        for (int c = 0; c < CHANNELS; c++) {
            double linear = 0.0, square = 0.0;
            for (int k = 0; k < 3; k++) linear += p->lean_by_up[i][c][k] * s->up[k];
            for (int k = 0; c == 0 && k < 3; k++)
                for (int n = 0; n < 3; n++) square += s->up[k] * p->lean_by_square[i][k][n] * s->up[n];
            if (c == 0) s->noise_power[i] = p->noise_power[i] + linear * p->lean_power[0] + square * p->lean_power[1];
            for (int o = 0; o < OUTPUTS; o++)
                for (int j = 0; j < one; j++)
                    s->noise_cross[i][o][c * one + j] = p->noise_cross[i][o][c * one + j]
                        + linear * p->lean_cross[0][o][j] + square * p->lean_cross[1][o][j];
        }
}

static void solve(Adaptive *s, int axis, int l, const Filter *p)
{
    double a[BANK][BANK], scale[BANK], count = s->count[axis][l], n0 = p->prior_blocks[l];
    double(*x)[sizeof(((Filter *)0)->onward[0][0]) / sizeof(double)] = s->solution;
    double power = (s->power[axis][l] + n0 * p->weighted_power[l] - s->noise_power[axis] * count) / (count + n0);
    if (power < p->least_power) power = p->least_power;
    double all = n0;
    for (int other = 0; other < 3; other++) all += p->share[axis][other] * s->count[other][l];
    for (int i = 0; i < BANK; i++) {
        for (int j = 0; j <= i; j++)
            a[i][j] = n0 * (power * p->tremor[l][i][j] + p->rest[axis][i][j]) + all * p->quiet[axis][i][j];
        for (int o = 0; o < OUTPUTS; o++) x[o][i] = n0 * power * p->cross[l][o][i];
    }
    for (int other = 0; other < 3; other++) {
        double rows = s->count[other][l], seen = s->power[other][l], share = p->share[axis][other];
        if (rows <= 0.0 || seen <= 0.0 || share <= 0.0) continue;
        double ratio = other == axis || power * rows > seen ? 1.0 : power * rows / seen;
        double factor = share * ratio, back = share * (1.0 - ratio) * rows;
        for (int i = 0; i < BANK; i++) {
            for (int j = 0; j <= i; j++) a[i][j] += factor * s->normal[other][l][i][j] + back * p->rest[other][i][j];
            for (int o = 0; o < OUTPUTS; o++) x[o][i] += factor * (s->right[other][l][o][i] - rows * s->noise_cross[other][o][i]);
        }
    }
    for (int i = 0; i < BANK; i++) scale[i] = 1.0 / sqrt(a[i][i]);
    for (int i = 0; i < BANK; i++)
        for (int j = 0; j <= i; j++) {
            double total = a[i][j] * scale[i] * scale[j] + (i == j ? 1e-9 : 0.0);
            for (int k = 0; k < j; k++) total -= a[i][k] * a[j][k];
            if (i > j) a[i][j] = total / a[j][j];
            else if (total > 0.0) a[i][i] = sqrt(total);
            else return;
        }
    for (int o = 0; o < OUTPUTS; o++) {
        for (int i = 0; i < BANK; i++) {
            double total = x[o][i] * scale[i];
            for (int k = 0; k < i; k++) total -= a[i][k] * x[o][k];
            x[o][i] = total / a[i][i];
        }
        for (int i = BANK - 1; i >= 0; i--) {
            double total = x[o][i];
            for (int k = i + 1; k < BANK; k++) total -= a[k][i] * x[o][k];
            x[o][i] = total / a[i][i];
        }
        for (int i = 0; i < BANK; i++) s->solved[axis][l][o][i] = x[o][i] * scale[i];
    }
}

static double section(double x, double *memory, const double *b)
{
    double y = b[0] * x + memory[0];
    memory[0] = b[1] * x - b[3] * y + memory[1];
    memory[1] = b[2] * x - b[4] * y;
    return y;
}

static void learn(Adaptive *s, const Filter *p)
{
    for (int i = 0; i < 3; i++) {
        double sample = s->pending[i][0];
        bank_turn(s->weighted[i], p);
        for (int c = 0; c < CHANNELS; c++) {
            double lifted = section(s->pending[i][c], s->weigh[i][c], p->weight);
            bank_add(s->weighted[i], c, lifted, p);
            if (c == 0) s->sum[i] += lifted;
        }
        double gated = section(sample, s->gate[i], p->gate);
        s->gate_power[i] += p->gate_smoothing * (gated * gated - s->gate_power[i]);
        s->burst[i] = s->gate_power[i] / (s->gate_power[i] + p->gate_power[i]);
    }
    if (++s->in_block < p->block_ticks) return;
    s->in_block = 0;
    int at = (int)s->n_blocks++;
    for (int i = 0; i < 3; i++) {
        s->blocks[i][at % TAPS_] = s->sum[i] / (double)p->block_ticks;
        s->sum[i] = 0.0;
        memcpy(s->snapshots[i][at % (LAG + 1)], s->weighted[i], BANK * sizeof(double));
        s->bursts[i][at % (LAG + 1)] = s->burst[i];
        if (at >= 2 * TAPS_) regress(s, i, at, p);
    }
    if (at >= 2 * TAPS_) know_noise(s, p);
    if (at >= 2 * TAPS_) solve(s, at % 3, at / 3 % LEVELS, p);
}

static double wrap(double phase) /* as the language of the firmware: into [0, 2 pi) */
{
    phase = fmod(phase, 2.0 * PI);
    return phase < 0.0 ? phase + 2.0 * PI : phase;
}

static void combine(double sample, estimate_state_combiner *s, const estimate_params_combiner *p)
{
    double in_band = sample;
    for (int j = 0; j < 3; j++) in_band = section(in_band, s->memory[j], p->sections[j]);
    estimate_state_combiner_wflc *w = &s->wflc;
    const estimate_params_combiner_wflc *q = &p->wflc;
    w->phase = wrap(w->phase + w->omega);
    w->power += q->power_smoothing * (in_band * in_band - w->power);
    double si = sin(w->phase), co = cos(w->phase);
    if (w->power > 0.0) {
        double normal = in_band / sqrt(w->power);
        normal = normal < -3.0 ? -3.0 : normal > 3.0 ? 3.0 : normal;
        double error = normal - w->sine * si - w->cosine * co;
        w->miss += q->power_smoothing * (error * error - w->miss);
        double omega = w->omega + 2.0 * q->frequency_gain * error * (w->sine * co - w->cosine * si);
        w->omega = omega < q->low ? q->low : omega > q->high ? q->high : omega;
        w->sine = q->keep * w->sine + 2.0 * q->weight_gain * si * error;
        w->cosine = q->keep * w->cosine + 2.0 * q->weight_gain * co * error;
    }
    s->fixed_phase = wrap(s->fixed_phase + q->start);
    if (p->weights_of == 2) si = sin(s->fixed_phase), co = cos(s->fixed_phase);
    double fitted = p->behind_prefilter ? in_band : sample, *v = s->weights;
    double error = fitted - v[0] * si - v[1] * co - v[2];
    v[0] += 2.0 * p->trailing_gain * si * error;
    v[1] += 2.0 * p->trailing_gain * co * error;
    v[2] += 2.0 * p->bias_gain * error;
}

static int estimate(double *f, estimate_state *s, const estimate_params *p)
{
    if (f[TICK] - s->last_tick != 1.0) return 1;
    Adaptive *a = &s->adaptive;
    const Filter *q = &p->adaptive;
    s->last_tick = f[TICK];
    s->ticks += 1.0;
    s->at = (s->at + 1) % 64;
    if (a->running) {
        learn(a, q);
        double *used = &a->filter[0][0][0][0], *solved = &a->solved[0][0][0][0];
        for (int n = 0; n < 3 * LEVELS * OUTPUTS * BANK; n++) used[n] += q->ease * (solved[n] - used[n]);
    }
    a->running = 1;
    double w = f[QUATERNION], x = f[QUATERNION + 1], y = f[QUATERNION + 2], z = f[QUATERNION + 3];
    a->up[0] = 2.0 * (x * z - w * y), a->up[1] = 2.0 * (y * z + w * x), a->up[2] = 1.0 - 2.0 * (x * x + y * y);
    for (int i = 0; i < 3; i++) {
        double sample = f[TIP_ACCELERATION + i], predicted[CHANNELS];
        s->samples[i] = sample;
        for (int c = 0; c < CHANNELS - 1; c++) {
            s->turned[i][c] = 0.0;
            for (int j = 0; j < 3; j++) s->turned[i][c] += p->lever[i][c][j] * f[ANGULAR_ACCELERATION + j];
        }
        for (int c = 0; c < CHANNELS; c++) {
            predicted[c] = 0.0;
            for (int j = 0; j < BANK; j++) predicted[c] += q->onward[i][c][j] * a->bank[i][j];
        }
        bank_turn(a->bank[i], q);
        for (int c = 0; c < CHANNELS; c++) bank_add(a->bank[i], c, predicted[c], q);
        combine(sample, &s->combiner[i], &p->combiner);
        for (int c = 0; c < CHANNELS; c++) {
            a->pending[i][c] = c ? s->turned[i][c - 1] : sample;
            bank_add(a->bank[i], c, a->pending[i][c] - predicted[c], q);
        }
    }
    for (int i = 0; i < 3; i++) {
        double sum[LEVELS][OUTPUTS] = {{0.0}}, out[OUTPUTS];
        for (int j = 0; j < BANK; j++)
            for (int l = 0; l < LEVELS; l++)
                for (int o = 0; o < OUTPUTS; o++) sum[l][o] += a->filter[i][l][o][j] * a->bank[i][j];
        for (int o = 0; o < OUTPUTS; o++) out[o] = sum[0][o] + a->burst[i] * (sum[1][o] - sum[0][o]);
        double now = out[0], ahead = out[1];
        double missed = now - s->predicted[i][(s->at - p->delay_ticks + 64) % 64];
        s->predicted[i][s->at] = ahead;
        s->power[i] += p->smoothing * (now * now - s->power[i]);
        s->miss[i] += p->smoothing * (missed * missed - s->miss[i]);
        f[TREMOR + i] = s->out[0][i] = now;
        f[TREMOR_AHEAD + i] = s->out[1][i] = ahead;
        f[TREMOR_CORE + i] = s->out[5][i] = out[2];
        f[TREMOR_FREQUENCY + i] = s->out[2][i] = s->combiner[i].wflc.omega * p->combiner.sensor.tick_hz / (2.0 * PI);
        f[TREMOR_AMPLITUDE + i] = s->out[3][i] = sqrt(2.0 * s->power[i]);
        double trust = 0.0;
        if (s->ticks > p->settle_ticks && !(p->needs_lock && s->combiner[i].wflc.miss > 0.7)) {
            trust = 1.0 - sqrt((s->miss[i] + p->floor2) / (s->power[i] + p->floor2));
            if (trust < 0.0) trust = 0.0;
        }
        f[CONFIDENCE + i] = s->out[4][i] = trust;
    }
    if (s->ticks <= p->settle_ticks) f[STATUS] = (int)f[STATUS] | SETTLING;
    return 0;
}

static void detect(double *f, detect_state *s, const detect_params *p)
{
    const double *x = f + TIP_ACCELERATION;
    s->ticks += 1.0;
    double gain = p->keep > 1.0 / s->ticks ? p->keep : 1.0 / s->ticks, slow = p->slow > 1.0 / s->ticks ? p->slow : 1.0 / s->ticks;
    double learns = s->held <= 0.0 ? gain : 0.1 * gain, size2 = 0.0;
    int settled = s->ticks > p->settle, jerk = 0;
    for (int i = 0; i < 3; i++) {
        s->slow_mean[i] += slow * (x[i] - s->slow_mean[i]);
        size2 += s->slow_mean[i] * s->slow_mean[i];
    }
    for (int band = 0; band < 2; band++) {
        double total = 0.0;
        for (int i = 0; i < 3; i++) {
            double y = x[i];
            for (int j = 0; j < 3; j++) y = section(y, s->memory[band][i][j], p->sections[band][j]);
            double power = s->power[band][i] + p->floor2, square = y * y;
            total += square / power;
            if (settled && square > p->limit * p->limit * power) square = p->limit * p->limit * power;
            s->power[band][i] += learns * (square - s->power[band][i]);
        }
        s->statistic[band] = total;
        jerk |= total > p->chi2[band];
    }
    if (settled && jerk) s->held = p->hold;
    else if (s->held > 0.0) s->held -= 1.0;
    double excess = s->excess + (sqrt(size2) - p->allowed) * p->dt;
    s->excess = excess < 0.0 ? 0.0 : excess > 2.0 * p->drift_limit ? 2.0 * p->drift_limit : excess;
    f[STATUS] = (int)f[STATUS] | (s->held > 0.0 ? JERK : 0) | (s->excess > p->drift_limit ? DRIFT : 0);
}

/* ---- actuation ---------------------------------------------------------------------------------------- */

typedef actuate_params_stacks Stack;
#define PLAYS ((int)(sizeof(((Stack *)0)->r) / sizeof(double)))
#define ZONES ((int)(sizeof(((Stack *)0)->d) / sizeof(double)))
#define CREEP ((int)(sizeof(((Stack *)0)->creep_keep) / sizeof(double)))

static double between(double x, double low, double high) { return x < low ? low : x > high ? high : x; }

static double zones(double y, const double *d, const double *s)
{
    double total = s[0] * y;
    for (int i = 1; i < ZONES; i++) total += s[i] * (y > d[i] ? y - d[i] : 0.0);
    return total;
}

static int strokes(const double *tip, const actuate_params_geometry *g, double *warm, double *out)
{
    double r = g->circle_m, l = g->shaft_m, x = tip[0] + g->rest_tip[0], y = tip[1] + g->rest_tip[1];
    double ax = warm[0], ay = warm[1], flat;
    for (int pass = 0;; pass++) {
        flat = ax * ax + ay * ay;
        if (!(flat < 1.0)) return 1;
        double az = sqrt(1.0 - flat), k = 1.0 / (1.0 + az), half = 0.5 * (ay * ay - ax * ax);
        double ex = x - l * ax - r * half * k, ey = y - l * ay - r * ax * ay * k;
        if (fabs(ex) + fabs(ey) < 1e-12) break;
        if (pass == 3) {
            if (fabs(ex) + fabs(ey) >= 1e-9) return 1;
            break;
        }
        double h = k * k / az;
        double m00 = l + r * (half * ax * h - ax * k), m01 = r * (half * ay * h + ay * k);
        double m10 = r * ay * (k + ax * ax * h), m11 = l + r * ax * (k + ay * ay * h), det = m00 * m11 - m01 * m10;
        ax += (m11 * ex - m01 * ey) / det;
        ay += (m00 * ey - m10 * ex) / det;
    }
    warm[0] = ax, warm[1] = ay;
    double centre = tip[2] + g->rest_tip[2] + l * flat / (1.0 + sqrt(1.0 - flat)), side = 0.5 * sqrt(3.0) * ay;
    out[0] = (centre - r * ax - g->rest_m[0]) / g->lever[0];
    out[1] = (centre + r * (0.5 * ax) - r * side - g->rest_m[1]) / g->lever[1];
    out[2] = (centre + r * (0.5 * ax) + r * side - g->rest_m[2]) / g->lever[2];
    return 0;
}

/* What the firmware remembers of the core's swing; a core beyond the stroke leaves the regular way. */
static int swings_too_far(const double *core, const actuate_params *p, actuate_state_yielding *s)
{
    double mean = 0.0, turned = 0.0, power = 0.0, change = 0.0, keep = p->yield_keep;
    for (int i = 0; i < 3; i++) {
        double by = core[i] - s->core_last[i];
        mean += core[i] / 3.0, turned += by / 3.0, power += core[i] * core[i], change += by * by;
    }
    s->core_power = keep * s->core_power + (1.0 - keep) * power;
    s->core_change = keep * s->core_change + (1.0 - keep) * change;
    double ticks = s->core_change > 0.0 ? sqrt(s->core_power / s->core_change) : 0.0;
    turned *= ticks;
    int beyond = 0;
    for (int i = 0; i < 3; i++) {
        double half = p->stroke_high[i] < -p->stroke_low[i] ? p->stroke_high[i] : -p->stroke_low[i];
        double most = p->overdrive * half, side = core[i] - mean;
        double across = ticks * (core[i] - s->core_last[i]) - turned, both = side * mean + across * turned;
        s->core_last[i] = core[i];
        beyond |= most > 0.0 && mean * mean + turned * turned + 2.0 * both > most * most - side * side - across * across;
    }
    double forget = ticks > 0.0 ? exp(-1.0 / (M_PI * ticks)) : 0.0;
    s->core_over = 1.0 + forget * (fmax(1.0, s->core_over) - 1.0);
    return beyond || s->core_over > 1.0001;
}

/* Nothing may be held back: that would leave the regular way. */
static int yields(const double *stroke, const double *core, const actuate_params *p, actuate_state_yielding *s)
{
    double mean = 0.0, room[3], over = 0.0, keep = p->yield_keep;
    if (swings_too_far(core, p, s)) return 1;
    for (int i = 0; i < 3; i++) mean += (stroke[i] - core[i]) / 3.0;
    for (int i = 0; i < 3; i++) {
        double half = p->stroke_high[i] < -p->stroke_low[i] ? p->stroke_high[i] : -p->stroke_low[i];
        s->core_peak[i] = fmax(keep * s->core_peak[i], fabs(core[i]));
        room[i] = fmax(0.1 * half, half - s->core_peak[i]);
        over = fmax(over, fabs(stroke[i] - core[i] - mean) / (0.9 * room[i]));
    }
    s->side_over = fmax(keep * s->side_over, over);
    over = 0.0;
    for (int i = 0; i < 3; i++) {
        s->side_peak[i] = fmax(keep * s->side_peak[i], fabs(stroke[i] - core[i] - mean));
        over = fmax(over, fabs(mean) / (room[i] - fmin(s->side_peak[i], 0.9 * room[i])));
    }
    s->axial_over = fmax(keep * s->axial_over, over);
    return s->side_over > 1.0 || s->axial_over > 1.0;
}

static int actuate(double *f, actuate_state *s, const actuate_params *p)
{
    double wish[3], least[3], core_tip[3], core_stroke[3];
    int ready = !((int)f[STATUS] & (ALIGNING | SETTLING)), clip = 0;
    for (int i = 0; i < 3; i++) {
        double ahead = f[TREMOR_AHEAD + i], core = f[TREMOR_CORE + i];
        int trusted = ready && f[CONFIDENCE + i] >= p->min_confidence && isfinite(ahead);
        s->on[i] = between(s->on[i] + (trusted ? p->ramp_step : -p->ramp_step), 0.0, 1.0);
        wish[i] = isfinite(ahead) ? -p->gain * s->on[i] * ahead : 0.0;
        least[i] = isfinite(ahead) && isfinite(core) ? -p->gain * s->on[i] * core : 0.0;
    }
    double *tip = f + DESIRED_TIP, *stroke = f + STROKE;
    for (int i = 0; i < 3; i++) {
        const double *row = p->mounting[i];
        tip[i] = row[0] * wish[0] + row[1] * wish[1] + row[2] * wish[2];
        core_tip[i] = row[0] * least[0] + row[1] * least[1] + row[2] * least[2];
    }
    if (strokes(tip, &p->geometry, s->tilt, stroke)) return 1;
    if (strokes(core_tip, &p->geometry, s->yielding.tilt, core_stroke)) return 1;
    if (yields(stroke, core_stroke, p, &s->yielding)) return 1;
    for (int i = 0; i < 3; i++)
        if (!(p->stroke_low[i] <= stroke[i] && stroke[i] <= p->stroke_high[i])) return 1;
    for (int i = 0; i < 3; i++) {
        const Stack *k = &p->stacks[i];
        double *past = s->strokes[i], *play = s->plays[i], *creep = s->creep[i], slope[PLAYS];
        memmove(past + 1, past, 15 * sizeof(double));
        past[0] = stroke[i];
        double target = 0.0;
        for (int n = 0; n < 16; n++) target += p->taps[i][n] * past[n];
        double rate = fabs(target - s->target[i]) * p->tick_hz;
        for (int n = 0; n < PLAYS; n++) {
            double w = rate > k->rate_low ? rate : k->rate_low;
            w = k->slope[n] + k->slope_per_rate[n] * (w < k->rate_high[n] ? w : k->rate_high[n]);
            if (!(w >= k->least_slope)) w = k->least_slope, clip |= CLIP_SINGULAR;
            slope[n] = w;
        }
        /* inverse */
        double rest = p->neutral_stroke[i] + target, gain = 1.0;
        for (int n = 0; n < CREEP; n++) {
            double share = (1.0 - k->creep_keep[n]) * k->creep_share[n];
            gain += share;
            rest += share * k->creep_reference - k->creep_keep[n] * creep[n];
        }
        double h = zones(rest / gain - k->offset, k->d_inverse, k->s_inverse) - k->level;
        double mapped = slope[0] * play[0], threshold = 0.0, x, inverse[PLAYS];
        for (int n = 0; n < PLAYS; n++) inverse[n] = 1.0 / slope[n];
        for (int n = 1; n < PLAYS; n++) mapped += (slope[n] - slope[n - 1]) * play[n];
        x = inverse[0] * between(mapped, h, h);
        for (int n = 1; n < PLAYS; n++) {
            mapped += slope[n - 1] * (play[n] - play[n - 1]);
            threshold += slope[n - 1] * (k->r[n] - k->r[n - 1]);
            x += (inverse[n] - inverse[n - 1]) * between(mapped, h - threshold, h + threshold);
        }
        double wanted = x + k->centre_V, inside = between(wanted, p->low_V, p->high_V);
        double command = between(inside, s->command_V[i] - p->slew_step_V, s->command_V[i] + p->slew_step_V);
        clip |= (inside != wanted ? CLIP_VOLTAGE : 0) | (command != inside ? CLIP_SLEW : 0);
        /* forward, to remember what the stack has seen */
        double drive = command - k->centre_V, sum = 0.0, before = 0.0;
        for (int n = 0; n < PLAYS; n++) {
            play[n] = between(play[n], drive - k->r[n], drive + k->r[n]);
            sum += (slope[n] - before) * play[n];
            before = slope[n];
        }
        double stroke = zones(sum + k->level, k->d, k->s) + k->offset;
        for (int n = 0; n < CREEP; n++)
            creep[n] = k->creep_keep[n] * creep[n] + (1.0 - k->creep_keep[n]) * k->creep_share[n] * (stroke - k->creep_reference);
        s->target[i] = target;
        s->command_V[i] = command;
        f[COMMAND + i] = command;
    }
    f[CLIP] = clip;
    return 0;
}

/* ---- the step ----------------------------------------------------------------------------------------- */

int instrument_step(double *f, sense_state *s, sense_params *sp, estimate_state *t, estimate_params *tp, detect_state *d,
         detect_params *dp, actuate_state *a, actuate_params *ap)
{
    if (sense(f, s, sp) || estimate(f, t, tp)) return 1;
    detect(f, d, dp);
    return (int)f[STATUS] & COMMANDED ? actuate(f, a, ap) : 0;
}

/* As run_kernel: rows (n, SIZE) in place; the number of rows done, less than n where one left the regular way. */
int instrument_run(double *rows, int n, double *f, sense_state *s, sense_params *sp, estimate_state *t, estimate_params *tp,
        detect_state *d, detect_params *dp, actuate_state *a, actuate_params *ap)
{
    for (int k = 0; k < n; k++) {
        double *row = rows + (long)k * SIZE;
        memcpy(f, row, VOLTS * sizeof(double));
        f[STATUS] = (int)row[STATUS] & GIVEN_BITS;
        if (instrument_step(f, s, sp, t, tp, d, dp, a, ap)) return k;
        memcpy(row, f, SIZE * sizeof(double));
    }
    return n;
}

/* One stage over the rows, for the table by stage: the others' columns are in the rows already. */
int instrument_run_stage(int stage, double *rows, int n, sense_state *s, sense_params *sp, estimate_state *t, estimate_params *tp,
              detect_state *d, detect_params *dp, actuate_state *a, actuate_params *ap)
{
    for (int k = 0; k < n; k++) {
        double *row = rows + (long)k * SIZE;
        if (stage == 0 ? sense(row, s, sp) : stage == 1 ? estimate(row, t, tp) : stage == 3 ? actuate(row, a, ap) : 0) return k;
        if (stage == 2) detect(row, d, dp);
    }
    return n;
}
