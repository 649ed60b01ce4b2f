/* Batches of complete records: loops over arrays of lines. */
#include "core.h"
#include "internal.h"

#define BLOCK 128 // records that are decoded together: their raw values stay in the cache
#define PAGES MAPLINES_MAX_PAGES

void maplines_pack(size_t count, const maplines_signal_t *signals, size_t n, size_t length,
                   const int64_t *raw, uint8_t *records)
{
    for (size_t i = 0; i < count; i++)
    {
        for (size_t row = 0; row < n; row++)
        {
            maplines_put(&signals[i], records + length * row, raw[n * i + row]);
        }
    }
}

void maplines_unpack(size_t count, const maplines_signal_t *signals, size_t n, size_t length,
                     const uint8_t *records, int64_t *raw)
{
    for (size_t i = 0; i < count; i++)
    {
        for (size_t row = 0; row < n; row++)
        {
            raw[n * i + row] = maplines_get(&signals[i], records + length * row);
        }
    }
}

void maplines_seal_record(const maplines_dbc_t *dbc, int owner, size_t length, uint32_t counter,
                          uint8_t *record)
{
    maplines_seal(dbc, owner, record, length, counter);
}

/* ---- encode ---------------------------------------------------------------------------------- */

bool maplines_check_gaussians(size_t n, double rounding, const double *mean, const double *cov,
                              double *symmetric, uint8_t *indefinite)
{
    bool is_good = true;
    for (size_t i = 0; i < n && is_good; i++)
    {
        for (size_t k = 0; k < 4; k++)
        {
            is_good = is_good && isfinite(mean[4 * i + k]);
        }
        is_good = is_good && maplines_check_covariance(cov + 16 * i, rounding) == MAPLINES_SENT;
        indefinite[i] = maplines_is_indefinite(cov + 16 * i, rounding);
        memcpy(symmetric + 16 * i, cov + 16 * i, 128);
        maplines_symmetric(4, symmetric + 16 * i);
    }
    return is_good;
}

/// Rows of the integers and of the reals.
enum {
    COUNTER,
    KIND,
    STATUS,
    INDEX,
    COUNT,
    WEIGHT = 0,
    X_MIN,
    X_MAX,
    AGE,
};

void maplines_encode_lines(const maplines_dbc_t *dbc, const double *const powers[5], size_t n,
                           const double *mean, const double *cov, const double *cover,
                           const uint8_t *indefinite, const int64_t *slot, const int64_t *integers,
                           const double *reals, uint8_t *records)
{
    const size_t length = 8U * (size_t)dbc->line.pages;
    memset(records, 0, n * length);
    for (size_t i = 0; i < n; i++)
    {
        maplines_input_t line;
        maplines_draft_t draft;
        line.slot = (maplines_owner_t)slot[i];
        line.kind = (maplines_kind_t)integers[KIND * n + i];
        line.status = (maplines_status_t)integers[STATUS * n + i];
        line.x_min = reals[X_MIN * n + i];
        line.x_max = reals[X_MAX * n + i];
        line.age = reals[AGE * n + i];
        line.has_age = true;
        draft.line = &line;
        draft.mean = mean + 4 * i;
        draft.is_indefinite = indefinite[i] != 0U;
        draft.index = (int)integers[INDEX * n + i];
        draft.count = (int)integers[COUNT * n + i];
        draft.weight = reals[WEIGHT * n + i];
        draft.powers = powers;
        memcpy(draft.cov, cov + 16 * i, sizeof draft.cov);
        for (size_t k = 0; k < 16; k++)
        {
            draft.cover[k] = cover == NULL ? 0.0 : cover[16 * i + k];
        }
        uint8_t *record = records + length * i;
        (void)maplines_write_complete(dbc, &draft, record);
        maplines_seal(dbc, (int)line.slot, record, length, (uint32_t)integers[COUNTER * n + i]);
    }
}

bool maplines_cover_mixtures(const maplines_dbc_t *dbc, size_t n, size_t k, const double *weights,
                             const double *means, const double *covs, double *decoded,
                             double *cover)
{
    maplines_component_t components[MAPLINES_MAX_COMPONENTS];
    for (size_t i = 0; k <= MAPLINES_MAX_COMPONENTS && i < n; i++)
    {
        for (size_t one = 0; one < k; one++)
        {
            const size_t place = k * i + one;
            components[one].weight = weights[place];
            memcpy(components[one].mean, means + 4 * place, sizeof components[one].mean);
            memcpy(components[one].cov, covs + 16 * place, sizeof components[one].cov);
        }
        maplines_cover_mixture(dbc, components, (int)k, decoded + k * i, cover + 16 * i);
    }
    return k <= MAPLINES_MAX_COMPONENTS;
}

/* ---- decode ------------------------------------------------------------------------------------
 *
 * Signal by signal over a block of records: a loop over an array of words, which compilers make
 * vectors of.
 */

/// Records of a block, as words of 8 bytes in both byte orders: Intel, Motorola.
typedef struct {
    int n;
    uint64_t words[2][PAGES + 1]
                  [BLOCK]; ///< the last page is zero: a signal may end with the record
} block_t;

/// Where the values of a block go to.
typedef struct {
    double *mean, *cov, *weight, *x_min, *x_max, *age;
    int64_t *counter, *kind, *status, *index, *count;
    int8_t *verdict;
} decoded_t;

/// Verdicts: see maplines_decode_lines.
enum {
    VERDICT_MIXED = 1,
    VERDICT_CRC = 2,
    VERDICT_CONTENT = 3,
};

static void load_words(const maplines_dbc_t *dbc, const uint8_t *records, int n, block_t *block)
{
    const int pages = dbc->line.pages;
    block->n = n;
    for (int page = 0; page < pages; page++)
    {
        uint64_t *intel = block->words[0][page];
        uint64_t *motorola = block->words[1][page];
        for (int row = 0; row < n; row++)
        {
            const uint8_t *b = records + 8 * (pages * row + page);
            const uint64_t word = (uint64_t)b[0] | (uint64_t)b[1] << 8U | (uint64_t)b[2] << 16U |
                                  (uint64_t)b[3] << 24U | (uint64_t)b[4] << 32U |
                                  (uint64_t)b[5] << 40U | (uint64_t)b[6] << 48U |
                                  (uint64_t)b[7] << 56U;
            const uint64_t halves = word << 32U | word >> 32U;
            const uint64_t pairs =
                (halves & 0x0000FFFF0000FFFFU) << 16U | (halves >> 16U & 0x0000FFFF0000FFFFU);
            intel[row] = word;
            motorola[row] =
                (pairs & 0x00FF00FF00FF00FFU) << 8U | (pairs >> 8U & 0x00FF00FF00FF00FFU);
        }
    }
}

/// Raw values of a signal of the page from which its bits are counted.
static void get_raw(const block_t *block, int page, const maplines_signal_t *signal, int64_t *raw)
{
    const int n = block->n;
    const uint64_t(*words)[BLOCK] = block->words[signal->is_motorola] + page + signal->first / 64;
    const unsigned place = signal->first % 64U;
    const unsigned unused = 64U - signal->length;
    const uint64_t sign = signal->is_signed ? (uint64_t)1 << (signal->length - 1U) : 0U;
    const unsigned left = signal->is_motorola ? place : unused - place;
    if (place <= unused)
    {
        for (int row = 0; row < n; row++)
        {
            raw[row] = (int64_t)(((words[0][row] << left >> unused) ^ sign) - sign);
        }
        return;
    }
    for (int row = 0; row < n; row++) // in two words
    {
        const uint64_t top = signal->is_motorola
                                 ? words[0][row] << place | words[1][row] >> (64U - place)
                                 : (words[0][row] >> place | words[1][row] << (64U - place))
                                       << unused;
        raw[row] = (int64_t)((top >> unused ^ sign) - sign);
    }
}

/// Physical values of raw values, to every `stride`-th place.
static void put_physical(const maplines_signal_t *signal, int n, const int64_t *raw, double *values,
                         int stride)
{
    const double factor = signal->scale->factor;
    const double offset = signal->scale->offset;
    for (int row = 0; row < n; row++)
    {
        const double scaled = (double)raw[row] * factor;
        values[stride * row] = scaled + offset;
    }
}

static void get_physical(const block_t *block, const maplines_signal_t *signal, double *values,
                         int stride)
{
    int64_t raw[BLOCK];
    get_raw(block, 0, signal, raw);
    put_physical(signal, block->n, raw, values, stride);
}

/// Checksums, two bytes a step as in maplines_crc; data IDs are the last two.
static void get_checksums(const maplines_dbc_t *dbc, const block_t *block, const uint16_t *data_ids,
                          uint16_t *crc)
{
    const int bytes = 8 * dbc->line.pages - 2; // without those of the checksum
    for (int row = 0; row < block->n; row++)
    {
        crc[row] = 0xFFFFU;
    }
    for (int i = 0; i <= bytes; i += 2)
    {
        const int first = i < dbc->line.crc_byte ? i : i + 2;
        const int second = i + 1 < dbc->line.crc_byte ? i + 1 : i + 3;
        const uint64_t *high = block->words[0][first / 8];
        const uint64_t *low = block->words[0][second / 8];
        const unsigned of_high = 8U * (unsigned)(first % 8);
        const unsigned of_low = 8U * (unsigned)(second % 8);
        for (int row = 0; row < block->n; row++)
        {
            const unsigned id = (data_ids[row] & 0xFFU) << 8U | data_ids[row] >> 8U;
            const unsigned pair =
                (unsigned)((high[row] >> of_high & 0xFFU) << 8U | (low[row] >> of_low & 0xFFU));
            const uint16_t v = (uint16_t)(crc[row] ^ (i < bytes ? pair : id));
            const uint16_t q = (uint16_t)(v ^ v >> 4U ^ v >> 8U ^ v >> 11U ^ v >> 12U);
            crc[row] = (uint16_t)(q ^ q << 5U ^ q << 12U);
        }
    }
}

/// Whether pages and checksums are those of intact records.
static void check_block(const maplines_dbc_t *dbc, const block_t *block, const uint8_t *records,
                        const uint16_t *data_ids, const int64_t *counter, int8_t *verdict)
{
    const maplines_record_t *layout = &dbc->line;
    const int64_t modulus = (int64_t)1 << layout->transfer_id[0].length;
    int64_t raw[BLOCK];
    uint16_t crc[BLOCK];
    get_checksums(dbc, block, data_ids, crc);
    for (int row = 0; row < block->n; row++)
    {
        const uint8_t *received = records + 8 * layout->pages * row + layout->crc_byte;
        const unsigned sent = (unsigned)received[0] | (unsigned)received[1] << 8U;
        verdict[row] = sent == crc[row] ? 0 : VERDICT_CRC;
    }
    for (int page = 0; page < layout->pages; page++)
    {
        get_raw(block, page, &layout->page, raw);
        for (int row = 0; row < block->n; row++)
        {
            verdict[row] = (int8_t)(raw[row] == page ? verdict[row] : VERDICT_MIXED);
        }
        get_raw(block, page, &layout->transfer_id[page == 0 ? 0 : 1], raw);
        for (int row = 0; row < block->n; row++)
        {
            const bool is_own = raw[row] == (counter[row] & (modulus - 1));
            verdict[row] = (int8_t)(is_own ? verdict[row] : VERDICT_MIXED);
        }
    }
}

/// Powers of 2 of a signal, times a share: from its table, or computed if there is none.
static void get_powers(const block_t *block, const maplines_signal_t *signal, const double *powers,
                       double share, double *values)
{
    int64_t raw[BLOCK];
    get_raw(block, 0, signal, raw);
    for (int row = 0; row < block->n; row++)
    {
        values[row] = powers != NULL ? powers[raw[row] - maplines_raw_min(signal)]
                                     : maplines_exp2(maplines_physical(signal, raw[row]) * share);
    }
}

/// Covariances F F^T; the terms are added in the order of the columns.
static void put_covariances(const maplines_dbc_t *dbc, const block_t *block,
                            const double *const powers[5], const int64_t *status, double *cov)
{
    static const double vague[4] = {1e6, 100.0, 100.0, 100.0}; // where none was sent
    const maplines_cholesky_t *code = &dbc->covariance;
    const uint8_t *order = code->order;
    double F[4][4][BLOCK];
    double scale[BLOCK];
    get_powers(block, &code->inflation, powers[4], 0.5, scale);
    for (int i = 0; i < 4; i++)
    {
        get_powers(block, &code->pivot[i], powers[i], 1.0, F[i][i]);
        for (int row = 0; row < block->n; row++)
        {
            F[i][i][row] = F[i][i][row] * scale[row];
        }
        for (int j = 0; j < i; j++)
        {
            get_physical(block, &code->ratio[i * (i - 1) / 2 + j], F[i][j], 1);
            for (int row = 0; row < block->n; row++)
            {
                F[i][j][row] = F[i][j][row] * F[i][i][row];
            }
        }
    }
    for (int i = 0; i < 4; i++)
    {
        for (int j = 0; j <= i; j++)
        {
            double *lower = cov + 4 * order[i] + order[j];
            double *upper = cov + 4 * order[j] + order[i];
            double sum[BLOCK];
            for (int row = 0; row < block->n; row++)
            {
                sum[row] = F[i][0][row] * F[j][0][row];
            }
            for (int k = 1; k <= j; k++)
            {
                for (int row = 0; row < block->n; row++)
                {
                    const double term = F[i][k][row] * F[j][k][row];
                    sum[row] = sum[row] + term;
                }
            }
            for (int row = 0; row < block->n; row++)
            {
                lower[16 * row] = sum[row];
                upper[16 * row] = sum[row];
            }
        }
    }
    for (int row = 0; row < block->n; row++)
    {
        if (status[row] == MAPLINES_UNKNOWN || status[row] == MAPLINES_OUT_OF_RANGE)
        {
            for (int k = 0; k < 16; k++)
            {
                cov[16 * row + k] = k % 5 == 0 ? vague[k / 5] : 0.0;
            }
        }
    }
}

/// Values beside mean and covariance, and whether a sender may send them.
static void put_values(const maplines_dbc_t *dbc, const block_t *block, const decoded_t *to)
{
    double values[BLOCK];
    int64_t raw[BLOCK];
    get_raw(block, 0, &dbc->status, to->status);
    get_raw(block, 0, &dbc->kind, to->kind);
    get_raw(block, 0, &dbc->component_index, to->index);
    get_physical(block, &dbc->component_count, values, 1);
    get_physical(block, &dbc->component_weight, to->weight, 1);
    get_physical(block, &dbc->x_min, to->x_min, 1);
    get_physical(block, &dbc->x_max, to->x_max, 1);
    get_raw(block, 0, &dbc->age, raw);
    put_physical(&dbc->age, block->n, raw, to->age, 1);
    for (int row = 0; row < block->n; row++)
    {
        to->count[row] = (int64_t)values[row];
        to->age[row] =
            raw[row] < maplines_raw_max(&dbc->age) ? to->age[row] / 1000.0 : (double)INFINITY;
        const bool is_turned = to->x_min[row] > to->x_max[row];
        const bool is_bad = to->status[row] > MAPLINES_OUT_OF_RANGE ||
                            to->kind[row] > MAPLINES_VIRTUAL || to->index[row] >= to->count[row] ||
                            (is_turned && to->status[row] != MAPLINES_OUT_OF_RANGE) ||
                            to->weight[row] <= 0.0 || to->weight[row] > 1.0;
        if (is_bad && to->verdict[row] == 0)
        {
            to->verdict[row] = VERDICT_CONTENT;
        }
        to->x_min[row] = is_turned ? to->x_max[row] : to->x_min[row];
    }
}

/// Decode a block of records; the arrays begin with its first row.
static void decode_block(const maplines_dbc_t *dbc, const uint8_t *records,
                         const uint16_t *data_ids, const double *const powers[5], block_t *block,
                         const decoded_t *to, int n)
{
    load_words(dbc, records, n, block);
    get_raw(block, 0, &dbc->line.counter, to->counter);
    check_block(dbc, block, records, data_ids, to->counter, to->verdict);
    put_values(dbc, block, to);
    for (int i = 0; i < 4; i++)
    {
        get_physical(block, &dbc->mean[i], to->mean + i, 4);
    }
    put_covariances(dbc, block, powers, to->status, to->cov);
}

// They are written to through the members of `to`, which clang-tidy does not see.
// NOLINTBEGIN(readability-non-const-parameter)
void maplines_decode_lines(const maplines_dbc_t *dbc, const double *const powers[5], size_t n,
                           const uint8_t *records, const uint16_t *data_ids, double *mean,
                           double *cov, int8_t *verdict, int64_t *integers, double *reals)
// NOLINTEND(readability-non-const-parameter)
{
    block_t block;
    memset(block.words, 0, sizeof block.words);
    for (size_t first = 0; first < n; first += BLOCK)
    {
        double *real = reals + first;
        int64_t *integer = integers + first;
        const decoded_t to = {mean + 4 * first,      cov + 16 * first,    real + WEIGHT * n,
                              real + X_MIN * n,      real + X_MAX * n,    real + AGE * n,
                              integer + COUNTER * n, integer + KIND * n,  integer + STATUS * n,
                              integer + INDEX * n,   integer + COUNT * n, verdict + first};
        decode_block(dbc, records + 8U * (size_t)dbc->line.pages * first, data_ids + first, powers,
                     &block, &to, n - first < BLOCK ? (int)(n - first) : BLOCK);
    }
}
