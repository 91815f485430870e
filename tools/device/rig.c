#include "rig.h"

#include <math.h>

static const double A[N_STATES][N_STATES] = PLANT_A, B[N_STATES][N_INPUTS] = PLANT_B, B_W[N_STATES] = PLANT_B_W,
                    C[N_STATES] = PLANT_C;

/* xorshift128+: good enough for noise, and the same on every processor. */
static uint64_t random_bits(struct rig *rig)
{
    uint64_t a = rig->random[0], b = rig->random[1];
    rig->random[0] = b;
    a ^= a << 23;
    rig->random[1] = a ^ b ^ a >> 17 ^ b >> 26;
    return rig->random[1] + b;
}

/* Marsaglia's polar method. */
static double normal(struct rig *rig)
{
    double a, b, square;
    if (rig->has_spare) {
        rig->has_spare = false;
        return rig->spare;
    }
    do {
        a = (double)(random_bits(rig) >> 11) * 0x1p-52 - 1.0;
        b = (double)(random_bits(rig) >> 11) * 0x1p-52 - 1.0;
        square = a * a + b * b;
    } while (square >= 1.0 || square == 0.0);
    double scale = sqrt(-2.0 * log(square) / square);
    rig->spare = b * scale;
    rig->has_spare = true;
    return a * scale;
}

void rig_begin_at_rest(struct rig *rig, uint64_t seed)
{
    /* splitmix64's finaliser, so that neighbouring seeds give unlike noise. */
    for (int i = 0; i < 2; i++) {
        uint64_t z = (seed * 2 + (uint64_t)i + 1) * 0x9e3779b97f4a7c15;
        z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9;
        z = (z ^ z >> 27) * 0x94d049bb133111eb;
        rig->random[i] = z ^ z >> 31;
    }
    rig->has_spare = false;
    rig->step = 0;
    for (int i = 0; i < N_STATES; i++)
        rig->x[0][i] = 0.0;
}

void rig_begin(struct rig *rig, uint64_t seed)
{
    static const double parked[N_INPUTS] = PARK_INPUTS;
    rig_begin_at_rest(rig, seed);
    /* The rig file's default is a stationary start. The slowest time constant is 1.5 s: twenty of them, in steps. */
    for (int i = 0; i < 30000; i++)
        rig_step(rig, parked);
    for (int i = 0; i < N_STATES; i++)
        rig->x[0][i] = rig->x[rig->step % STATES_KEPT][i];
    rig->step = 0;
}

/* x(k+1) = A x(k) + B u(k) + B_w w(k) */
void rig_step(struct rig *rig, const double u[N_INPUTS])
{
    const double *x = rig->x[rig->step % STATES_KEPT];
    double *next = rig->x[(rig->step + 1) % STATES_KEPT], w = sqrt(PROCESS_NOISE) * normal(rig);
    for (int i = 0; i < N_STATES; i++) {
        next[i] = B_W[i] * w;
        for (int j = 0; j < N_STATES; j++)
            next[i] += A[i][j] * x[j];
        for (int j = 0; j < N_INPUTS; j++)
            next[i] += B[i][j] * u[j];
    }
    rig->step++;
}

/* theta(k) = C x(k) */
static double spot(const struct rig *rig, uint64_t step)
{
    double theta = 0.0;
    for (int i = 0; i < N_STATES; i++)
        theta += C[i] * rig->x[step % STATES_KEPT][i];
    return theta;
}

/* Y(omega) = (1/N) sum of Psi(omega - theta_i) + eta. A pixel measures the mean of Y over its width D: the kernel's
 * integral between its edges, with Psi(w) = exp(-w^2 / sigma^2) / (sigma sqrt(pi)), over D; eta has variance V / D. */
void rig_frame(struct rig *rig, uint64_t first_step, uint8_t counts[2 * WIDTH * HEIGHT])
{
    const double width = (FIELD_HIGH - FIELD_LOW) / WIDTH, noise_sd = sqrt(NOISE_DENSITY / width);
    double light[WIDTH] = {0.0}; /* integrals, summed over the steps */
    for (uint64_t step = first_step; step < first_step + EXPOSURE_STEPS; step++) {
        double theta = spot(rig, step), left = erf((FIELD_LOW - theta) / KERNEL_SIGMA);
        for (int i = 0; i < WIDTH; i++) {
            double right = erf((FIELD_LOW + (i + 1) * width - theta) / KERNEL_SIGMA);
            light[i] += 0.5 * (right - left);
            left = right;
        }
    }
    for (int i = 0; i < WIDTH; i++) {
        double density = light[i] / (EXPOSURE_STEPS * width) + noise_sd * normal(rig);
        double count = floor(BLACK_LEVEL + COUNTS_PER_DENSITY * density + 0.5), most = (1 << BIT_DEPTH) - 1;
        uint16_t word = (uint16_t)(count < 0.0 ? 0.0 : count > most ? most : count);
        counts[2 * i] = (uint8_t)word;
        counts[2 * i + 1] = (uint8_t)(word >> 8);
    }
}

void rig_truth(const struct rig *rig, uint64_t first_step, double start[N_STATES], double end[N_STATES],
               double path[EXPOSURE_STEPS])
{
    for (int i = 0; i < N_STATES; i++) {
        start[i] = rig->x[first_step % STATES_KEPT][i];
        end[i] = rig->x[(first_step + EXPOSURE_STEPS) % STATES_KEPT][i];
    }
    for (int i = 0; i < EXPOSURE_STEPS; i++)
        path[i] = spot(rig, first_step + (uint64_t)i);
}
