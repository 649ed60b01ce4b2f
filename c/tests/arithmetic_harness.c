/* Functions of numbers and matrices, for any numbers.
 *
 * Input, case by case, after a command (u8); numbers are f64, and matrices rows of these:
 *   0  x; output: its power of 2, logarithm, sine, cosine, tangent and arc tangent
 *   1  a (4, 4) matrix; output: its inverse
 *   2  n (u8), a symmetric (n, n) matrix; output: its eigenvalues and eigenvectors
 *   3  a symmetric (4, 4) matrix; output: whether it is indefinite (u8), the nearest covariance
 *   4  n lines (u8), (4 n, 4 n) covariances to be covered and due to the pose, n own covariances
 *      and n bases; output: whether they do not cover (u8), and if so what each of them lacks
 *   5  two (4, 4) covariances; output: divergence of the second from the first, largest ratio
 *   6  a mean, a factor (4, 4), the order of its rows (4 u8); output: mean and factor of a receiver
 *   7  x, y; output: the length of the vector
 */
#include "binary.h"
#include "propagation.h"

static void read_numbers(int n, double *values)
{
    for (int i = 0; i < n; ++i)
    {
        values[i] = read_f64();
    }
}

static void write_numbers(int n, const double *values)
{
    for (int i = 0; i < n; ++i)
    {
        write_f64(values[i]);
    }
}

static void compute_elementary(void)
{
    const double x = read_f64();
    double sine, cosine;
    maplines_sin_cos(x, &sine, &cosine);
    const double values[6] = {
        maplines_exp2(x), maplines_log2(x), sine, cosine, maplines_tan(x), maplines_atan(x),
    };
    write_numbers(6, values);
}

static void invert(void)
{
    double A[16], inverse[16];
    read_numbers(16, A);
    maplines_inverse(A, inverse);
    write_numbers(16, inverse);
}

static void find_eigenvalues(void)
{
    static double A[MAPLINES_STATES * MAPLINES_STATES], V[MAPLINES_STATES * MAPLINES_STATES];
    double values[MAPLINES_STATES];
    const int n = read_u8();
    read_numbers(n * n, A);
    maplines_eigen(n, A, values, V);
    write_numbers(n, values);
    write_numbers(n * n, V);
}

static void repair(void)
{
    double S[16], nearest[16];
    read_numbers(16, S);
    write_u8(maplines_is_indefinite(S));
    maplines_nearest_covariance(S, nearest);
    write_numbers(16, nearest);
}

static void find_uncovered(void)
{
    static double target[MAPLINES_STATES * MAPLINES_STATES];
    static double spread[MAPLINES_STATES * MAPLINES_STATES];
    static maplines_joint_space_t space;
    double own[MAPLINES_SLOTS][16], J[MAPLINES_SLOTS][16], lacking[MAPLINES_SLOTS][16];
    const int lines = read_u8();
    read_numbers(16 * lines * lines, target);
    read_numbers(16 * lines * lines, spread);
    read_numbers(16 * lines, own[0]);
    read_numbers(16 * lines, J[0]);
    const bool is_lacking = maplines_uncovered(lines, target, spread, own, J, &space, lacking);
    write_u8(is_lacking);
    write_numbers(is_lacking ? 16 * lines : 0, lacking[0]);
}

static void compare(void)
{
    double cov[16], decoded[16];
    maplines_reference_t reference;
    read_numbers(16, cov);
    read_numbers(16, decoded);
    maplines_compare_with(cov, &reference);
    write_f64(maplines_divergence(&reference, decoded));
    write_f64(maplines_largest_ratio(&reference, decoded));
}

static void set_gaussian(void)
{
    double mean[4], factor[4][4];
    uint8_t order[4];
    maplines_gaussian_t gaussian;
    read_numbers(4, mean);
    read_numbers(16, factor[0]);
    read_bytes(order, 4);
    maplines_set_gaussian(mean, factor, order, &gaussian);
    for (int i = 0; i < 20; ++i)
    {
        write_f64((double)(i < 4 ? gaussian.mean[i] : gaussian.factor[(i - 4) / 4][i % 4]));
    }
}

static void find_length(void)
{
    const double x = read_f64();
    write_f64(maplines_hypot(x, read_f64()));
}

int main(void)
{
    static void (*const commands[])(void) = {
        compute_elementary, invert,  find_eigenvalues, repair,
        find_uncovered,     compare, set_gaussian,     find_length,
    };
    while (!at_end())
    {
        const unsigned command = read_u8();
        if (command >= sizeof commands / sizeof *commands)
        {
            return 4;
        }
        commands[command]();
    }
    return 0;
}
