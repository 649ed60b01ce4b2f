/* A covariance as pivots, ratios and an inflation. maplines_can/wire/layout/cholesky.py says
 * why it is coded so.
 */
#include "internal.h"

#define INFLATION_MARGIN 1e-6 // of the inflation
#define AMPLIFIED_MARGIN                                                                           \
    0x1p-47                // margin for each variance in units of the decoded one: 32 roundings
#define LIFT_SLACK 1e-9    // of a division, before a pivot is lifted by whole steps
#define MAX_LIFTS 3        // most times that a pivot is lifted
#define MAX_ATTEMPTS 8     // most times that a covariance is encoded
#define WIDER_TARGET 1.02  // factor on the scale each time
#define FIRST_RATIO 4      // in the raw values, after 4 pivots
#define INFLATION_PLACE 10 // in the raw values

/// Place of ratio (i, j) among the ratios.
static int ratio_index(int i, int j)
{
    return i * (i - 1) / 2 + j;
}

/// Power of 2 of a value, from the table of its signal if there is one.
static double power_of(const maplines_signal_t *signal, const double *table, int64_t raw)
{
    if (table != NULL)
    {
        return table[raw - maplines_raw_min(signal)];
    }
    return maplines_exp2(maplines_physical(signal, raw));
}

MAPLINES_INTERNAL void maplines_decode_factor(const maplines_cholesky_t *code,
                                              const uint8_t *record, double factor[4][4])
{
    const double inflation = maplines_value(&code->inflation, record);
    const double scale = maplines_exp2(inflation * 0.5);
    for (int i = 0; i < (int)code->rows; ++i)
    {
        double *row = factor[code->order[i]];
        const double sigma =
            power_of(&code->pivot[i], NULL, maplines_get(&code->pivot[i], record)) * scale;
        for (int j = 0; j < i; ++j)
        {
            const maplines_signal_t *ratio = &code->ratio[ratio_index(i, j)];
            row[j] = maplines_value(ratio, record) * sigma;
        }
        for (int j = i; j < 4; ++j)
        {
            row[j] = j == i ? sigma : 0.0;
        }
    }
    for (int i = (int)code->rows; i < 4; ++i)
    {
        memset(factor[i], 0, sizeof factor[i]);
    }
}

#if MAPLINES_SENDER

MAPLINES_INTERNAL void maplines_widest_covariance(const maplines_cholesky_t *code, int64_t raw[11])
{
    memset(raw, 0, 11 * sizeof(int64_t));
    for (int i = 0; i < (int)code->rows; ++i)
    {
        raw[i] = maplines_raw_max(&code->pivot[i]);
        for (int j = 0; j < i; ++j)
        {
            const maplines_signal_t *ratio = &code->ratio[ratio_index(i, j)];
            raw[FIRST_RATIO + ratio_index(i, j)] =
                maplines_limited(ratio, maplines_nearest_raw(ratio, 0.0));
        }
    }
    raw[INFLATION_PLACE] = maplines_raw_max(&code->inflation);
}

MAPLINES_INTERNAL void maplines_put_covariance(const maplines_cholesky_t *code, uint8_t *record,
                                               const int64_t raw[11])
{
    for (int i = 0; i < (int)code->rows; ++i)
    {
        maplines_put(&code->pivot[i], record, raw[i]);
        for (int j = 0; j < i; ++j)
        {
            const int index = ratio_index(i, j);
            maplines_put(&code->ratio[index], record, raw[FIRST_RATIO + index]);
        }
    }
    maplines_put(&code->inflation, record, raw[INFLATION_PLACE]);
}

/// A factor while it is quantized, by rows in the order of the DBC. All three are lower triangular;
/// nothing is above their diagonals.
typedef struct {
    double target[4][4];  ///< L: of the target, given the entries already quantized
    double decoded[4][4]; ///< L'
    double A[4][4];       ///< L'^-1 L
    int64_t *raw;
} maplines_quantized_t;

/// Terms from `begin` on of a row and a column, added to the first one.
static double row_by_column(const double *row, double (*columns)[4], int column, int begin, int end)
{
    double sum = 0.0;
    for (int k = begin; k < end; ++k)
    {
        const double term = row[k] * columns[k][column];
        sum = sum + term;
    }
    return sum;
}

/// Quantize row i left of its pivot, from the diagonal outwards. Returns the factor by which the
/// decoded pivot is too small for the ratios; 1 if they fit.
static double choose_ratios(const maplines_cholesky_t *code, int i, double sigma,
                            maplines_quantized_t *q)
{
    double overflow = 1.0;
    double *row = q->decoded[i];
    row[i] = sigma;
    for (int j = i - 1; j >= 0; --j)
    {
        const maplines_signal_t *ratio = &code->ratio[ratio_index(i, j)];
        const double rest = q->target[i][j] - row_by_column(row, q->A, j, j + 1, i);
        const double wanted = rest / (q->A[j][j] * sigma);
        const double nearest = maplines_nearest_raw(ratio, wanted);
        const int64_t limited = maplines_limited(ratio, nearest);
        const double decoded = maplines_physical(ratio, limited);
        if ((double)limited != nearest)
        {
            const double end = fabs(decoded) + ratio->scale->factor / 2.0;
            const double excess = fabs(wanted) / end;
            overflow = excess > overflow ? excess : overflow;
        }
        q->raw[FIRST_RATIO + ratio_index(i, j)] = limited;
        row[j] = decoded * sigma;
    }
    return overflow;
}

/// Quantize row i of the factor of a target S, whose squared pivot is at least `floor_i`. Returns
/// whether its pivot was lifted.
static bool quantize_row(const maplines_cholesky_t *code, const double *const powers[5], int i,
                         const double S[4], double floor_i, maplines_quantized_t *q)
{
    const maplines_signal_t *pivot = &code->pivot[i];
    double *target = q->target[i];
    double squares = 0.0;
    for (int j = 0; j < i; ++j)
    {
        double sum = 0.0;
        for (int k = 0; k < j; ++k)
        {
            const double term = target[k] * q->target[j][k];
            sum = sum + term;
        }
        target[j] = (S[j] - sum) / q->target[j][j];
    }
    for (int j = 0; j < i; ++j)
    {
        const double square = target[j] * target[j];
        squares = squares + square;
    }
    const double variance = S[i] - squares;
    double exact = sqrt(variance > floor_i ? variance : floor_i);
    const double nearest = maplines_nearest_raw(pivot, maplines_log2(exact));
    int64_t chosen = maplines_limited(pivot, nearest);
    double sigma = power_of(pivot, powers[i], chosen);
    double overflow = choose_ratios(code, i, sigma, q);
    for (int trial = 0; trial < MAX_LIFTS && overflow > 1.0; ++trial)
    {
        const double lift = ceil(maplines_log2(overflow) / pivot->scale->factor + LIFT_SLACK);
        chosen = maplines_limited(pivot, (double)chosen + (lift > 1.0 ? lift : 1.0));
        sigma = power_of(pivot, powers[i], chosen);
        overflow = choose_ratios(code, i, sigma, q);
    }
    // The target takes over a lifted pivot, so the entries below it become smaller.
    const bool is_lifted = (double)chosen > nearest;
    exact = is_lifted ? sigma : exact;
    q->raw[i] = chosen;
    target[i] = exact;
    for (int j = 0; j < i; ++j)
    {
        q->A[i][j] = (target[j] - row_by_column(q->decoded[i], q->A, j, j, i)) / sigma;
    }
    q->A[i][i] = exact / sigma;
    return is_lifted;
}

/// W = L^-1 M L^-T, and the margin for its rounding; n rows of M are in the order of those of L.
static double whiten(int n, double L[4][4], double M[4][4], double *W)
{
    double X[4][4]; // rows of L^-1
    double amplification = 0.0;
    for (int i = 0; i < n; ++i)
    {
        const double inverse = 1.0 / L[i][i];
        for (int j = 0; j < i; ++j)
        {
            X[i][j] = -inverse * row_by_column(L[i], X, j, j, i);
        }
        X[i][i] = inverse;
    }
    for (int i = 0; i < n; ++i)
    {
        double XM[4];
        double sum = 0.0;
        for (int j = 0; j <= i; ++j)
        {
            XM[j] = row_by_column(X[i], M, j, 0, i + 1);
        }
        for (int j = 0; j <= i; ++j)
        {
            double entry = 0.0;
            for (int k = 0; k <= j; ++k)
            {
                const double term = XM[k] * X[j][k];
                entry = entry + term;
            }
            W[n * i + j] = entry;
            W[n * j + i] = entry;
        }
        for (int k = 0; k <= i; ++k)
        {
            const double term = X[i][k] * X[i][k] * M[k][k];
            sum = sum + term;
        }
        amplification = amplification + sum;
    }
    return INFLATION_MARGIN + AMPLIFIED_MARGIN * amplification;
}

/// Whether a raw inflation covers a target W, which is whitened.
static bool covers(const maplines_signal_t *inflation, const double *table, double raw, int n,
                   const double *W, double margin)
{
    double rest[16];
    const double given = power_of(inflation, table, (int64_t)raw);
    const double diagonal = (given - margin) / (1.0 + INFLATION_MARGIN);
    for (int i = 0; i < n * n; ++i)
    {
        rest[i] = -W[i];
    }
    for (int i = 0; i < n; ++i)
    {
        rest[(n + 1) * i] = rest[(n + 1) * i] + diagonal;
    }
    return maplines_cholesky_factor(n, rest, rest);
}

/// Ratio of the inflation that a target W needs to the largest one, 1 or more.
static double missing_inflation(const maplines_signal_t *inflation, const double *table, int n,
                                double *W, double margin)
{
    double values[4] = {0};
    maplines_eigen(n, W, values, NULL);
    double largest = values[0];
    for (int i = 1; i < n; ++i)
    {
        largest = values[i] > largest ? values[i] : largest;
    }
    const double needed = (largest > 0.0 ? largest : 0.0) * (1.0 + INFLATION_MARGIN) + margin;
    const double excess = needed / power_of(inflation, table, maplines_raw_max(inflation));
    return excess > 1.0 ? excess : 1.0;
}

/// The least raw inflation that covers a target W; false if none does.
static bool least_inflation(const maplines_signal_t *inflation, const double *table, int n,
                            const double *W, double margin, int64_t *raw)
{
    const double most = (double)maplines_raw_max(inflation);
    double bound = W[0];
    for (int i = 1; i < n; ++i)
    {
        bound = W[(n + 1) * i] > bound ? W[(n + 1) * i] : bound;
    }
    const double exponent = maplines_log2(bound * (1.0 + INFLATION_MARGIN) + margin);
    const double steps = ceil((exponent - inflation->scale->offset) / inflation->scale->factor);
    double high = (double)maplines_limited(inflation, steps);
    double low = high - 1.0; // the highest raw value that is known not to cover
    double step = 1.0;
    bool fits = covers(inflation, table, high, n, W, margin);
    while (!fits && high < most) // steps double: at most 54 times
    {
        low = high;
        high = high + step < most ? high + step : most;
        step = step * 2.0;
        fits = covers(inflation, table, high, n, W, margin);
    }
    while (fits && high - low > 1.0) // halved each time
    {
        const double middle = low + floor((high - low) / 2.0);
        if (covers(inflation, table, middle, n, W, margin))
        {
            high = middle;
        }
        else
        {
            low = middle;
        }
    }
    *raw = (int64_t)high;
    return fits;
}

/// 3 of a pose error, or 4 of a line: so compilers know the loops over them.
static int rows_of(const maplines_cholesky_t *code)
{
    int rows = 4;
    if (code->rows == 3U)
    {
        rows = 3;
    }
    return rows;
}

/// Encode a target once, multiplied by a scale. Returns whether it is covered; if not, `excess` is
/// the ratio of the needed to the available inflation.
static bool encode_once(const maplines_cholesky_t *code, const double *const powers[5],
                        const double *target, const double *resolution, double scale,
                        int64_t raw[11], bool *is_saturated, double *excess)
{
    const int n = rows_of(code);
    double M[4][4];
    double W[16];
    maplines_quantized_t q;
    q.raw = raw;
    *is_saturated = false;
    for (int i = 0; i < n; ++i)
    {
        double S[4];
        const double floor_i = resolution[code->order[i]] * scale;
        for (int j = 0; j < n; ++j)
        {
            M[i][j] = target[n * code->order[i] + code->order[j]];
            const double scaled = scale * M[i][j];
            S[j] = j == i ? scaled + floor_i : scaled;
        }
        if (quantize_row(code, powers, i, S, floor_i, &q))
        {
            *is_saturated = true;
        }
    }
    const double margin = whiten(n, q.decoded, M, W);
    if (least_inflation(&code->inflation, powers[4], n, W, margin, &raw[INFLATION_PLACE]))
    {
        return true;
    }
    *excess = missing_inflation(&code->inflation, powers[4], n, W, margin);
    return false;
}

MAPLINES_INTERNAL bool maplines_encode_covariance(const maplines_cholesky_t *code,
                                                  const double *const powers[5],
                                                  const double *target, const double *resolution,
                                                  int64_t raw[11], bool *is_saturated)
{
    static const double *const no_tables[5] = {NULL};
    const int n = (int)code->rows;
    bool is_covered = true;
    *is_saturated = false;
    for (int i = 0; i < n; ++i)
    {
        // Beyond this no pivot and ratios can cover, and encoding may overflow; nor with NaN.
        is_covered = is_covered && target[(n + 1) * i] < 4.0 * code->reachable[i];
    }
    if (is_covered)
    {
        const double *const *tables = powers == NULL ? no_tables : powers;
        double scale = 1.0;
        double excess = 1.0;
        memset(raw, 0, 11 * sizeof(int64_t));
        is_covered =
            encode_once(code, tables, target, resolution, scale, raw, is_saturated, &excess);
        // Once is enough, unless the inflation of the DBC is too small for its steps, or a value is
        // clipped. Then encode again, for a target that is scaled by what was missing.
        for (int attempt = 1; attempt < MAX_ATTEMPTS && !is_covered; ++attempt)
        {
            scale = WIDER_TARGET * scale * excess;
            is_covered =
                encode_once(code, tables, target, resolution, scale, raw, is_saturated, &excess);
        }
    }
    if (!is_covered)
    {
        maplines_widest_covariance(code, raw);
    }
    return is_covered;
}

#endif
