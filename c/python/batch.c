/* Batches of complete records: the loops of wire/records over arrays of lines.
 *
 * The arrays are made and checked in Python; here only their sizes are looked at, so that no
 * mistake there becomes an access beyond an array. All are in C order. Python's threads run
 * meanwhile.
 */
#include "native.h"

#define BLOCK 128 // records that are decoded together: their raw values stay in the cache
#define PAGES MAPLINES_MAX_PAGES

/* ---- arrays ---------------------------------------------------------------------------------- */

/// Hold the tables of a tuple: the powers of 2 of the pivots, by row, and of the inflation. False
/// with an exception if they are not those of a code.
static bool hold_powers(maplines_arrays_t *arrays, PyObject *tables,
                        const maplines_cholesky_t *code, maplines_powers_t *powers)
{
    if (!PyTuple_Check(tables) || PyTuple_Size(tables) != 5)
    {
        PyErr_SetString(PyExc_TypeError, "powers must be a tuple of 5 tables");
        return false;
    }
    for (int i = 0; i < 5; i++)
    {
        const maplines_signal_t *signal = i < 4 ? &code->pivot[i] : &code->inflation;
        const Py_ssize_t values = (Py_ssize_t)(signal->raw_max - signal->raw_min + 1);
        PyObject *table = PyTuple_GetItem(tables, i); // borrowed
        const double *held = maplines_hold(arrays, table, 8 * values, false);
        if (held == NULL)
        {
            return false;
        }
        *(i < 4 ? &powers->pivot[i] : &powers->inflation) = held;
    }
    return true;
}

/// Number of rows: the length of an array. -1 with an exception if there are other than so many
/// arguments, or if it has none.
static Py_ssize_t rows_of(PyObject *const *args, Py_ssize_t given, Py_ssize_t wanted, int place)
{
    if (given != wanted)
    {
        PyErr_Format(PyExc_TypeError, "there must be %zd arguments, got %zd", wanted, given);
        return -1;
    }
    return PyObject_Size(args[place]);
}

/* ---- encode ---------------------------------------------------------------------------------- */

PyDoc_STRVAR(
    check_gaussians_doc,
    "check_gaussians(mean, cov, symmetric, indefinite) -> whether all may be sent.\n\n"
    "As layout.validation.checked_gaussians for (n, 4) and (n, 4, 4) of double precision;\n"
    "it fills symmetric (n, 4, 4) and indefinite (n,).");

static PyObject *check_gaussians(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    (void)module;
    maplines_arrays_t arrays;
    arrays.count = 0;
    bool is_good = true;
    const Py_ssize_t n = rows_of(args, count, 4, 0);
    if (n < 0)
    {
        return NULL;
    }
    const double *mean = maplines_hold(&arrays, args[0], 32 * n, false);
    const double *cov = mean == NULL ? NULL : maplines_hold(&arrays, args[1], 128 * n, false);
    double *symmetric = cov == NULL ? NULL : maplines_hold(&arrays, args[2], 128 * n, true);
    uint8_t *indefinite = symmetric == NULL ? NULL : maplines_hold(&arrays, args[3], n, true);
    if (indefinite == NULL)
    {
        maplines_release_arrays(&arrays);
        return NULL;
    }
    Py_BEGIN_ALLOW_THREADS;
    for (Py_ssize_t i = 0; i < n && is_good; i++)
    {
        for (int k = 0; k < 4; k++)
        {
            is_good = is_good && isfinite(mean[4 * i + k]);
        }
        is_good = is_good && maplines_check_covariance(cov + 16 * i) == MAPLINES_SENT;
        indefinite[i] = maplines_is_indefinite(cov + 16 * i);
        memcpy(symmetric + 16 * i, cov + 16 * i, 128);
        maplines_symmetric(4, symmetric + 16 * i);
    }
    Py_END_ALLOW_THREADS;
    maplines_release_arrays(&arrays);
    return PyBool_FromLong(is_good);
}

/// Lines to be encoded: an array for each value, of so many rows.
typedef struct {
    const double *mean, *cov, *cover; ///< cover may be NULL
    const uint8_t *indefinite;
    const int64_t *slot, *counter, *kind, *status, *index, *count;
    const double *weight, *x_min, *x_max, *age;
    uint8_t *records;
} lines_t;

static void encode_row(const maplines_dbc_t *dbc, const maplines_powers_t *powers,
                       const lines_t *lines, Py_ssize_t i)
{
    const size_t length = 8U * (size_t)dbc->line.pages;
    uint8_t *record = lines->records + length * (size_t)i;
    maplines_input_t line;
    maplines_draft_t draft;
    line.slot = (maplines_owner_t)lines->slot[i];
    line.kind = (maplines_kind_t)lines->kind[i];
    line.status = (maplines_status_t)lines->status[i];
    line.x_min = lines->x_min[i];
    line.x_max = lines->x_max[i];
    line.age = lines->age[i];
    draft.line = &line;
    draft.mean = lines->mean + 4 * i;
    draft.is_indefinite = lines->indefinite[i] != 0U;
    draft.index = (int)lines->index[i];
    draft.count = (int)lines->count[i];
    draft.weight = lines->weight[i];
    draft.powers = powers;
    memcpy(draft.cov, lines->cov + 16 * i, sizeof draft.cov);
    for (int k = 0; k < 16; k++)
    {
        draft.cover[k] = lines->cover == NULL ? 0.0 : lines->cover[16 * i + k];
    }
    memset(record, 0, length);
    (void)maplines_write_complete(dbc, &draft, record);
    maplines_seal(dbc, (int)line.slot, record, length, (uint32_t)lines->counter[i]);
}

PyDoc_STRVAR(
    encode_records_doc,
    "encode_records(tables, powers, mean, cov, indefinite, cover, slot, counter, kind, status,\n"
    "    index, count, weight, x_min, x_max, age, records) -> None.\n\n"
    "As CompleteWriter.write for values that it has checked: (n,) int64, or float64 from\n"
    "the weight on. cover may be None. powers are the tables of the pivots, by row, and\n"
    "of the inflation.");

static PyObject *encode_records(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    maplines_arrays_t arrays;
    arrays.count = 0;
    const Py_ssize_t n = rows_of(args, count, 17, 2);
    const maplines_dbc_t *dbc = n < 0 ? NULL : maplines_dbc_of(module, args[0]);
    if (dbc == NULL)
    {
        return NULL;
    }
    maplines_powers_t powers;
    const void *in[15] = {NULL};
    bool is_held = hold_powers(&arrays, args[1], &dbc->covariance, &powers);
    for (int i = 1; is_held && i < 15; i++)
    {
        const Py_ssize_t size = i == 1 ? 32 : i == 2 || i == 4 ? 128 : i == 3 ? 1 : 8;
        if (i != 4 || args[i + 1] != Py_None)
        {
            in[i] = maplines_hold(&arrays, args[i + 1], size * n, false);
            is_held = in[i] != NULL;
        }
    }
    lines_t lines = {in[1], in[2],  in[4],  in[3],  in[5],  in[6],  in[7], in[8],
                     in[9], in[10], in[11], in[12], in[13], in[14], NULL};
    lines.records =
        is_held ? maplines_hold(&arrays, args[16], 8 * (Py_ssize_t)dbc->line.pages * n, true)
                : NULL;
    if (lines.records == NULL)
    {
        maplines_release_arrays(&arrays);
        return NULL;
    }
    Py_BEGIN_ALLOW_THREADS;
    for (Py_ssize_t i = 0; i < n; i++)
    {
        encode_row(dbc, &powers, &lines, i);
    }
    Py_END_ALLOW_THREADS;
    maplines_release_arrays(&arrays);
    Py_RETURN_NONE;
}

PyDoc_STRVAR(cover_mixtures_doc,
             "cover_mixtures(tables, weights, means, covs, steps, decoded, cover) -> None.\n\n"
             "As CompleteWriter._cover for (n, k), (n, k, 4) and (n, k, 4, 4); it fills decoded\n"
             "(n, k) and cover (n, 4, 4). k may not exceed max_components.");

static void cover_one(const maplines_dbc_t *dbc, int k, int64_t steps, const double *weights,
                      const double *means, const double *covs, double *decoded, double *cover)
{
    double own_means[MAPLINES_MAX_COMPONENTS][4];
    double own_covs[MAPLINES_MAX_COMPONENTS][16];
    double decoded_means[MAPLINES_MAX_COMPONENTS][4];
    memcpy(own_means, means, 32U * (size_t)k);
    memcpy(own_covs, covs, 128U * (size_t)k);
    for (int i = 0; i < 4 * k; i++)
    {
        const maplines_signal_t *signal = &dbc->mean[i % 4];
        const double raw = maplines_nearest_raw(signal, means[i]);
        decoded_means[i / 4][i % 4] = maplines_physical(signal, maplines_limited(signal, raw));
    }
    maplines_quantize_weights(k, weights, steps, decoded);
    maplines_deficit(k, weights, own_means, own_covs, decoded, decoded_means, cover);
}

static PyObject *cover_mixtures(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    maplines_arrays_t arrays;
    arrays.count = 0;
    const Py_ssize_t n = rows_of(args, count, 7, 1);
    const maplines_dbc_t *dbc = n < 0 ? NULL : maplines_dbc_of(module, args[0]);
    const int64_t steps = dbc == NULL ? -1 : PyLong_AsLongLong(args[4]);
    if (PyErr_Occurred() != NULL)
    {
        return NULL;
    }
    // The number of components is that of the arrays together: n rows of k weights.
    Py_buffer weights;
    if (PyObject_GetBuffer(args[1], &weights, PyBUF_CONTIG_RO) < 0)
    {
        return NULL;
    }
    const Py_ssize_t k = n > 0 ? weights.len / (8 * n) : 0;
    PyBuffer_Release(&weights);
    if (k > MAPLINES_MAX_COMPONENTS)
    {
        PyErr_SetString(PyExc_ValueError, "there are more components than the core can hold");
        return NULL;
    }
    const double *given = maplines_hold(&arrays, args[1], 8 * n * k, false);
    const double *means = given == NULL ? NULL : maplines_hold(&arrays, args[2], 32 * n * k, false);
    const double *covs = means == NULL ? NULL : maplines_hold(&arrays, args[3], 128 * n * k, false);
    double *decoded = covs == NULL ? NULL : maplines_hold(&arrays, args[5], 8 * n * k, true);
    double *cover = decoded == NULL ? NULL : maplines_hold(&arrays, args[6], 128 * n, true);
    if (cover == NULL)
    {
        maplines_release_arrays(&arrays);
        return NULL;
    }
    Py_BEGIN_ALLOW_THREADS;
    for (Py_ssize_t i = 0; i < n; i++)
    {
        cover_one(dbc, (int)k, steps, given + k * i, means + 4 * k * i, covs + 16 * k * i,
                  decoded + k * i, cover + 16 * i);
    }
    Py_END_ALLOW_THREADS;
    maplines_release_arrays(&arrays);
    Py_RETURN_NONE;
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

/// Decoded records: where the values of a block go to.
typedef struct {
    double *mean, *cov, *x_min, *x_max, *age, *weight;
    int64_t *status, *kind, *index, *count, *counter;
    int8_t *verdict;
} decoded_t;

/// Powers of 2 of a signal by its raw value from `least` on.
typedef struct {
    const double *values;
    int64_t least, last; ///< last: number of values less 1
} powers_t;

/// Verdicts, in the order of records.packer.VERDICTS.
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
    const double factor = signal->factor;
    const double offset = signal->offset;
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

/// Powers of 2 of a signal; raw values beyond the range of the DBC are clipped to it.
static void get_powers(const block_t *block, const maplines_signal_t *signal, powers_t powers,
                       double *values)
{
    int64_t raw[BLOCK];
    get_raw(block, 0, signal, raw);
    for (int row = 0; row < block->n; row++)
    {
        const int64_t above = raw[row] - powers.least;
        const int64_t place = above < 0 ? 0 : above;
        values[row] = powers.values[place < powers.last ? place : powers.last];
    }
}

/// Covariances F F^T; the terms are added in the order of the columns.
static void put_covariances(const maplines_dbc_t *dbc, const block_t *block, const powers_t *powers,
                            const int64_t *status, double *cov)
{
    static const double vague[4] = {1e6, 100.0, 100.0, 100.0}; // where none was sent
    const maplines_cholesky_t *code = &dbc->covariance;
    const uint8_t *order = code->order;
    double F[4][4][BLOCK];
    double scale[BLOCK];
    get_powers(block, &code->inflation, powers[4], scale);
    for (int i = 0; i < 4; i++)
    {
        get_powers(block, &code->pivot[i], powers[i], F[i][i]);
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
        to->age[row] = raw[row] < dbc->age.raw_max ? to->age[row] / 1000.0 : (double)INFINITY;
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
                         const uint16_t *data_ids, const powers_t *powers, block_t *block,
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

/// Decode all records, block by block.
static void decode_all(const maplines_dbc_t *dbc, const uint8_t *records, const uint16_t *data_ids,
                       const powers_t *powers, decoded_t to, Py_ssize_t n)
{
    block_t block;
    memset(block.words, 0, sizeof block.words);
    while (n > 0)
    {
        const int now = n < BLOCK ? (int)n : BLOCK;
        decode_block(dbc, records, data_ids, powers, &block, &to, now);
        n -= now;
        records += 8 * dbc->line.pages * now;
        data_ids += now;
        to.mean += 4 * now;
        to.cov += 16 * now;
        to.verdict += now;
        to.status += now;
        to.kind += now;
        to.x_min += now;
        to.x_max += now;
        to.age += now;
        to.index += now;
        to.count += now;
        to.weight += now;
        to.counter += now;
    }
}

PyDoc_STRVAR(decode_records_doc,
             "decode_records(tables, records, data_ids, powers, mean, cov, verdict, status, kind,\n"
             "    x_min, x_max, age, index, count, weight, counter) -> None.\n\n"
             "As CompleteFormat.read: it fills the fields of a Batch from mean on. powers are the\n"
             "tables of the pivots, by row, and of the square roots of the inflation.");

static PyObject *decode_records(PyObject *module, PyObject *const *args, Py_ssize_t count)
{
    static const uint8_t sizes[] = {32, 128, 1, 8, 8, 8, 8, 8, 8, 8, 8, 8};
    maplines_arrays_t arrays;
    arrays.count = 0;
    const Py_ssize_t n = rows_of(args, count, 16, 1);
    const maplines_dbc_t *dbc = n < 0 ? NULL : maplines_dbc_of(module, args[0]);
    if (dbc == NULL)
    {
        return NULL;
    }
    maplines_powers_t tables;
    powers_t powers[5];
    void *out[12] = {NULL};
    const uint8_t *records =
        maplines_hold(&arrays, args[1], 8 * (Py_ssize_t)dbc->line.pages * n, false);
    const uint16_t *data_ids =
        records == NULL ? NULL : maplines_hold(&arrays, args[2], 2 * n, false);
    bool is_held = data_ids != NULL;
    is_held = is_held && hold_powers(&arrays, args[3], &dbc->covariance, &tables);
    for (int i = 0; is_held && i < 5; i++)
    {
        const maplines_signal_t *signal =
            i < 4 ? &dbc->covariance.pivot[i] : &dbc->covariance.inflation;
        powers[i].least = signal->raw_min;
        powers[i].last = signal->raw_max - signal->raw_min;
        powers[i].values = i < 4 ? tables.pivot[i] : tables.inflation;
    }
    for (int i = 0; is_held && i < 12; i++)
    {
        out[i] = maplines_hold(&arrays, args[4 + i], sizes[i] * n, true);
        is_held = out[i] != NULL;
    }
    if (!is_held)
    {
        maplines_release_arrays(&arrays);
        return NULL;
    }
    const decoded_t to = {out[0], out[1], out[5], out[6], out[7],  out[10],
                          out[3], out[4], out[8], out[9], out[11], out[2]};
    Py_BEGIN_ALLOW_THREADS;
    decode_all(dbc, records, data_ids, powers, to, n);
    Py_END_ALLOW_THREADS;
    maplines_release_arrays(&arrays);
    Py_RETURN_NONE;
}

static PyMethodDef functions[] = {
    {"check_gaussians", (PyCFunction)(void (*)(void))check_gaussians, METH_FASTCALL,
     check_gaussians_doc},
    {"encode_records", (PyCFunction)(void (*)(void))encode_records, METH_FASTCALL,
     encode_records_doc},
    {"cover_mixtures", (PyCFunction)(void (*)(void))cover_mixtures, METH_FASTCALL,
     cover_mixtures_doc},
    {"decode_records", (PyCFunction)(void (*)(void))decode_records, METH_FASTCALL,
     decode_records_doc},
    {NULL, NULL, 0, NULL},
};

int maplines_add_batch(PyObject *module)
{
    return PyModule_AddFunctions(module, functions);
}
