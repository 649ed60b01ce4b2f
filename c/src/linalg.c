/* Linear algebra with a fixed order of operations: that of model/matrices.py.
 *
 * Matrices are arrays of their rows. Where there are n of something, n is at most MAPLINES_STATES.
 */
#include "internal.h"

MAPLINES_INTERNAL double maplines_inner(int n, const double *a, int by_a, const double *b, int by_b)
{
    double sum = a[0] * b[0];
    for (int l = 1; l < n; ++l)
    {
        const double term = a[l * by_a] * b[l * by_b];
        sum = sum + term;
    }
    return sum;
}

/// C = A B: (n, k) times (k, m). C is another array than A and B.
MAPLINES_INTERNAL void maplines_product(int n, int k, int m, const double *A, const double *B,
                                        double *C)
{
    for (int i = 0; i < n; ++i)
    {
        for (int j = 0; j < m; ++j)
        {
            C[i * m + j] = maplines_inner(k, A + i * k, 1, B + j, m);
        }
    }
}

/// C = A B^T: (n, k) times (m, k) transposed. C is another array than A and B.
MAPLINES_INTERNAL void maplines_product_transposed(int n, int k, int m, const double *A,
                                                   const double *B, double *C)
{
    for (int i = 0; i < n; ++i)
    {
        for (int j = 0; j < m; ++j)
        {
            C[i * m + j] = maplines_inner(k, A + i * k, 1, B + j * k, 1);
        }
    }
}

/// C = A A^T for an (n, k) matrix A, exactly symmetric. C is another array than A.
MAPLINES_INTERNAL void maplines_gram(int n, int k, const double *A, double *C)
{
    for (int i = 0; i < n; ++i)
    {
        for (int j = 0; j <= i; ++j)
        {
            const double entry = maplines_inner(k, A + i * k, 1, A + j * k, 1);
            C[i * n + j] = entry;
            C[j * n + i] = entry;
        }
    }
}

/// Mean of an (n, n) matrix and its transpose, in place.
MAPLINES_INTERNAL void maplines_symmetric(int n, double *A)
{
    for (int i = 0; i < n; ++i)
    {
        for (int j = 0; j <= i; ++j)
        {
            const double mean = (A[i * n + j] + A[j * n + i]) / 2.0;
            A[i * n + j] = A[j * n + i] = mean;
        }
    }
}

/// C = A S A^T, exactly symmetric, for (4, 4) matrices. C is another array than A and S.
MAPLINES_INTERNAL void maplines_congruence(const double A[16], const double S[16], double C[16])
{
    double AS[16];
    maplines_product(4, 4, 4, A, S, AS);
    maplines_product_transposed(4, 4, 4, AS, A, C);
    maplines_symmetric(4, C);
}

/// Sum of n values, which it overwrites: the second half is added to the first until one is left.
MAPLINES_INTERNAL double maplines_total(int n, double *values)
{
    while (n > 1)
    {
        const int half = (n + 1) / 2;
        for (int i = 0; i < n - half; ++i)
        {
            values[i] = values[i] + values[half + i];
        }
        n = half;
    }
    return values[0];
}

#if MAPLINES_SENDER
/// Lower triangular factor of a (4, 4) matrix, as maplines_cholesky_factor.
static bool factor_of_four(const double S[16], double L[16])
{
    const double pivot_0 = S[0];
    const double l_0 = sqrt(pivot_0);
    const double l_10 = S[4] / l_0;
    const double l_20 = S[8] / l_0;
    const double l_30 = S[12] / l_0;
    const double pivot_1 = S[5] - l_10 * l_10;
    const double rest_21 = S[9] - l_20 * l_10;
    const double rest_31 = S[13] - l_30 * l_10;
    const double l_1 = sqrt(pivot_1);
    const double l_21 = rest_21 / l_1;
    const double l_31 = rest_31 / l_1;
    const double rest_2 = S[10] - l_20 * l_20;
    const double pivot_2 = rest_2 - l_21 * l_21;
    const double rest_32 = S[14] - l_30 * l_20;
    const double l_2 = sqrt(pivot_2);
    const double l_32 = (rest_32 - l_31 * l_21) / l_2;
    const double rest_3 = S[15] - l_30 * l_30;
    const double last_3 = rest_3 - l_31 * l_31;
    const double pivot_3 = last_3 - l_32 * l_32;
    const double factor[16] = {l_0,  0.0,  0.0, 0.0, l_10, l_1,  0.0,  0.0,
                               l_20, l_21, l_2, 0.0, l_30, l_31, l_32, sqrt(pivot_3)};
    memcpy(L, factor, sizeof factor);
    return pivot_0 > 0.0 && pivot_1 > 0.0 && pivot_2 > 0.0 && pivot_3 > 0.0;
}

/// Lower triangular factor of an (n, n) matrix, of which the lower part is read. L may be S.
/// Returns whether all pivots are positive; if not, the rest of L is undefined.
MAPLINES_INTERNAL bool maplines_cholesky_factor(int n, const double *S, double *L)
{
    double columns[4][MAPLINES_STATES]; // of L, four at a time: each entry is read once for them
    if (n == 4)
    {
        return factor_of_four(S, L);
    }
    for (int i = 0; i < n; ++i)
    {
        for (int j = 0; j < n; ++j)
        {
            L[i * n + j] = j <= i ? S[i * n + j] : 0.0;
        }
    }
    for (int begin = 0; begin < n; begin += 4)
    {
        const int end = begin + 4 < n ? begin + 4 : n;
        for (int k = begin; k < end; ++k)
        {
            double *column = columns[k - begin];
            const double pivot = L[k * n + k];
            if (!(pivot > 0.0))
            {
                return false;
            }
            const double root = sqrt(pivot);
            L[k * n + k] = root;
            for (int i = k + 1; i < n; ++i)
            {
                double *row = L + i * n;
                column[i] = row[k] / root;
                row[k] = column[i];
                for (int j = k + 1; j <= i && j < end; ++j)
                {
                    const double term = column[i] * column[j];
                    row[j] = row[j] - term;
                }
            }
        }
        for (int i = end; i < n; ++i)
        {
            double *row = L + i * n;
            const double factor[4] = {row[begin], row[begin + 1], row[begin + 2], row[begin + 3]};
            for (int j = end; j <= i; ++j)
            {
                const double one = row[j] - factor[0] * columns[0][j];
                const double two = one - factor[1] * columns[1][j];
                const double three = two - factor[2] * columns[2][j];
                row[j] = three - factor[3] * columns[3][j];
            }
        }
    }
    return true;
}

#else

/// As with a sender, which factors many large matrices: the same operations, row by row.
MAPLINES_INTERNAL bool maplines_cholesky_factor(int n, const double *S, double *L)
{
    for (int i = 0; i < n; ++i)
    {
        double *row = L + i * n;
        for (int j = 0; j <= i; ++j)
        {
            double rest = S[i * n + j];
            for (int k = 0; k < j; ++k)
            {
                const double term = row[k] * L[j * n + k];
                rest = rest - term;
            }
            if (j == i && !(rest > 0.0))
            {
                return false;
            }
            row[j] = j == i ? sqrt(rest) : rest / L[j * n + j];
        }
        memset(row + i + 1, 0, (size_t)(n - 1 - i) * sizeof(double));
    }
    return true;
}

#endif

/// Solution X of L X = B, in place of the (n, m) matrix B, for a lower triangular (n, n) matrix.
MAPLINES_INTERNAL void maplines_lower_solution(int n, int m, const double *L, double *B)
{
    for (int i = 0; i < n; ++i)
    {
        for (int j = 0; j < m; ++j)
        {
            double rest = B[i * m + j];
            for (int k = 0; k < i; ++k)
            {
                const double term = L[i * n + k] * B[k * m + j];
                rest = rest - term;
            }
            B[i * m + j] = rest / L[i * n + i];
        }
    }
}

/// Solution X of L^T X = B, in place of the (n, m) matrix B, for a lower triangular (n, n) matrix.
MAPLINES_INTERNAL void maplines_upper_solution(int n, int m, const double *L, double *B)
{
    for (int k = n - 1; k >= 0; --k)
    {
        for (int j = 0; j < m; ++j)
        {
            B[k * m + j] = B[k * m + j] / L[k * n + k];
            for (int i = 0; i < k; ++i)
            {
                const double term = L[k * n + i] * B[k * m + j];
                B[i * m + j] = B[i * m + j] - term;
            }
        }
    }
}

/// Inverse of a (4, 4) matrix; not finite if it is singular.
MAPLINES_INTERNAL void maplines_inverse(const double A[16], double out[16])
{
    double M[4][8];
    for (int i = 0; i < 4; ++i)
    {
        for (int j = 0; j < 4; ++j)
        {
            M[i][j] = A[4 * i + j];
            M[i][4 + j] = i == j ? 1.0 : 0.0;
        }
    }
    for (int k = 0; k < 4; ++k)
    {
        int chosen = k; // the first largest; a NaN counts as the largest
        for (int i = k + 1; i < 4; ++i)
        {
            const double size = fabs(M[i][k]);
            const double largest = fabs(M[chosen][k]);
            if (largest == largest && (size > largest || size != size))
            {
                chosen = i;
            }
        }
        for (int j = 0; j < 8; ++j)
        {
            const double upper = M[chosen][j];
            M[chosen][j] = M[k][j];
            M[k][j] = upper;
        }
        const double pivot = M[k][k];
        for (int j = 0; j < 8; ++j)
        {
            M[k][j] = M[k][j] / pivot;
        }
        for (int i = 0; i < 4; ++i)
        {
            if (i != k)
            {
                const double share = M[i][k];
                for (int j = 0; j < 8; ++j)
                {
                    const double term = share * M[k][j];
                    M[i][j] = M[i][j] - term;
                }
            }
        }
    }
    for (int i = 0; i < 4; ++i)
    {
        memcpy(out + 4 * i, M[i] + 4, 4 * sizeof(double));
    }
}

/// Pairs of round `round` of a tournament of n; returns their number.
static int pairs_of_round(int n, int round, int p[], int q[])
{
    const int even = n + n % 2;
    int count = 0;
    for (int i = 0; i < even / 2; ++i)
    {
        // The players but the first are a ring that moves on by one place a round.
        const int a = i == 0 ? 0 : 1 + (i - 1 - round + 2 * (even - 1)) % (even - 1);
        const int b = 1 + (even - 2 - i - round + 2 * (even - 1)) % (even - 1);
        const int low = a < b ? a : b;
        const int high = a < b ? b : a;
        if (high < n)
        {
            p[count] = low;
            q[count] = high;
            ++count;
        }
    }
    return count;
}

/// Rotate columns p and q of an (n, n) matrix.
static void rotate_columns(int n, double *M, int p, int q, double c, double s)
{
    for (int i = 0; i < n; ++i)
    {
        const double left = M[i * n + p];
        const double right = M[i * n + q];
        const double c_left = c * left;
        const double s_right = s * right;
        const double s_left = s * left;
        const double c_right = c * right;
        M[i * n + p] = c_left - s_right;
        M[i * n + q] = s_left + c_right;
    }
}

/// Eigenvalues and eigenvectors (the columns of V) of a symmetric (n, n) matrix, in no order, by
/// Jacobi's method; A is overwritten. V may be NULL.
MAPLINES_INTERNAL void maplines_eigen(int n, double *A, double *values, double *V)
{
    int p[MAPLINES_STATES / 2 + 1];
    int q[MAPLINES_STATES / 2 + 1];
    double c[MAPLINES_STATES / 2 + 1];
    double s[MAPLINES_STATES / 2 + 1];
    for (int i = 0; V != NULL && i < n * n; ++i)
    {
        V[i] = i % (n + 1) == 0 ? 1.0 : 0.0;
    }
    const int rounds = n + n % 2 - 1;
    for (int sweep = 0; sweep < 16; ++sweep)
    {
        bool is_done = true;
        for (int round = 0; round < rounds; ++round)
        {
            const int count = pairs_of_round(n, round, p, q);
            bool turns_any = false;
            for (int i = 0; i < count; ++i)
            {
                const double a = A[p[i] * n + p[i]];
                const double b = A[q[i] * n + q[i]];
                const double off = A[p[i] * n + q[i]];
                c[i] = 1.0;
                s[i] = 0.0;
                if (fabs(off) > 0x1p-60 * sqrt(fabs(a * b)))
                {
                    const double theta = (b - a) / (2.0 * off);
                    const double square = theta * theta + 1.0;
                    double t = 1.0 / (fabs(theta) + sqrt(square));
                    t = theta < 0.0 ? -t : t;
                    const double tangent = t * t + 1.0;
                    c[i] = 1.0 / sqrt(tangent);
                    s[i] = t * c[i];
                    turns_any = true;
                }
            }
            if (turns_any)
            {
                is_done = false;
                for (int i = 0; i < count; ++i)
                {
                    rotate_columns(n, A, p[i], q[i], c[i], s[i]);
                    if (V != NULL)
                    {
                        rotate_columns(n, V, p[i], q[i], c[i], s[i]);
                    }
                }
                for (int i = 0; i < count; ++i)
                {
                    for (int j = 0; j < n; ++j)
                    {
                        const double upper = A[p[i] * n + j];
                        const double lower = A[q[i] * n + j];
                        const double c_upper = c[i] * upper;
                        const double s_lower = s[i] * lower;
                        const double s_upper = s[i] * upper;
                        const double c_lower = c[i] * lower;
                        A[p[i] * n + j] = c_upper - s_lower;
                        A[q[i] * n + j] = s_upper + c_lower;
                    }
                }
            }
            for (int i = 0; i < count; ++i)
            {
                A[p[i] * n + q[i]] = A[q[i] * n + p[i]] = 0.0;
            }
        }
        if (is_done)
        {
            break;
        }
    }
    for (int i = 0; i < n; ++i)
    {
        values[i] = A[i * n + i];
    }
}
