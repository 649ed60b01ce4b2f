/* What is seen of lines of the map. */
#include "propagation.h"

#include <float.h>

#define DIRECTION_BASE 0.5 ///< over which the direction of a line is taken [m]
#define STRIDE 32          ///< points from one of which the distance is taken to the next
#define LEAP 8             ///< the same to the begin of a cell
#define ROUNDING 1e-9      ///< of distances, relative
#define MOST_ERROR 1.0     ///< that points show; more is a corner of the line [m]
#define MOST_SAGITTA 3.0   ///< the same for their distances from chords [m]
#define ERRORS 30.0        ///< points of which errors are taken, if the line has so many
#define SAGITTAS 8.0       ///< and distances from chords
#define PER_FREEDOM 2.63   ///< squared fourth differences for a degree of freedom
#define TYPICAL 1.8e-4     ///< error that is typical by the squared spacing of points [1/m] ...
#define MOST_TYPICAL 0.06  ///< ... at most [m] ...
#define TYPICAL_COUNT 1.5  ///< ... and the degrees of freedom for which it counts
#define STUDENT 1.3    ///< of the widening by Student's t, which holds 3 sigma from 3 degrees on
#define BETWEEN 7e-4   ///< variance of a line between its points by the squared sagitta, if many
#define FEW_POINTS 9.0 ///< with which it is twice as much
#define BY_TYPICAL 0.3 ///< the same by the square of the typical error
#define BY_ERROR 0.1   ///< and by that of the errors that points show, if they are far apart
#define FAR_APART 10.0 ///< spacing at which half of that counts [m]
#define COARSE 12.0    ///< distance of points that show kinks, at least [m]
#define PER_KINK 26.2  ///< intensity of kinks by their squared error and distance to the power -3
#define AS_ERRORS 1.4  ///< of the errors of close points, what explains those of far points ...
#define AS_ERRORS_FAR 0.5 ///< ... and of points that are no closer
#define HIDING 0.04       ///< kinks that errors can hide, by their variance [1/m^3]
#define AVERAGED 5.0      ///< distance over which they are averaged [m]

/* ---- paths ------------------------------------------------------------------------------------
 */

/// Set the chords of steps, which extend half a base to both sides of the middle of each.
static void set_chords(const double *x, const double *y, const double *distance, size_t count,
                       double *cx, double *cy)
{
    size_t begin = 0;
    size_t end = 0;
    for (size_t i = 0; i + 1 < count; ++i)
    {
        const double middle = (distance[i + 1] + distance[i]) / 2.0;
        while (begin + 1 < count && distance[begin + 1] <= middle - DIRECTION_BASE / 2.0)
        {
            ++begin;
        }
        while (end + 1 < count && distance[end] < middle + DIRECTION_BASE / 2.0)
        {
            ++end;
        }
        cx[i] = x[end] - x[begin];
        cy[i] = y[end] - y[begin];
    }
}

/// Square of a length up to the square of another one; 0 if it is not a number.
static double capped(double square, double most)
{
    const double positive = square > 0.0 ? square : 0.0;
    return positive < most * most ? positive : most * most;
}

/// Squared error that five points show: their fourth divided difference, in standard deviations for
/// independent errors of 1 m. Errors along the line cancel.
static double error_of(const maplines_path_t *path, const size_t at[5])
{
    double sum_x = 0.0;
    double sum_y = 0.0;
    double squares = 0.0;
    for (size_t j = 0; j < 5; ++j)
    {
        double product = 1.0;
        for (size_t k = 0; k < 5; ++k)
        {
            const double gap = path->distance[at[j]] - path->distance[at[k]];
            product = j == k ? product : product * gap;
        }
        const double weight = 1.0 / product;
        const double by_x = weight * (path->x[at[j]] - path->x[at[2]]);
        const double by_y = weight * (path->y[at[j]] - path->y[at[2]]);
        sum_x = sum_x + by_x;
        sum_y = sum_y + by_y;
        squares = squares + weight * weight;
    }
    return capped((sum_x * sum_x + sum_y * sum_y) / squares, MOST_ERROR);
}

/// Squared error that a point and the two next to it on each side show.
static double shown_error(const maplines_path_t *path, size_t i)
{
    const size_t at[5] = {i - 2, i - 1, i, i + 1, i + 2};
    return error_of(path, at);
}

/// Move two points behind the middle one of five, and two ahead, to the nearest that are not closer
/// to each other than `COARSE`. They never move back, as the middle one moves on. False if there
/// are none.
static bool spread(const maplines_path_t *path, size_t at[5])
{
    for (size_t k = 2; k > 0; --k)
    {
        const double least = path->distance[at[k]] - COARSE;
        if (path->distance[0] > least)
        {
            return false;
        }
        while (at[k - 1] + 1 < at[k] && path->distance[at[k - 1] + 1] <= least)
        {
            ++at[k - 1];
        }
    }
    for (size_t k = 2; k < 4; ++k)
    {
        const double least = path->distance[at[k]] + COARSE;
        while (at[k + 1] < path->count && path->distance[at[k + 1]] < least)
        {
            ++at[k + 1];
        }
        if (at[k + 1] == path->count)
        {
            return false;
        }
    }
    return true;
}

/// Set the sums of the squared errors that points far apart show, and of their distances.
static void set_coarse(maplines_path_t *path, double *errors, double *distances)
{
    size_t at[5] = {0, 0, 0, 0, 0};
    double error = 0.0;
    double distance = 0.0;
    path->coarse_ends[0] = 0;
    path->coarse_ends[1] = 0;
    for (size_t i = 0; i < path->count; ++i)
    {
        errors[i] = error;
        distances[i] = distance;
        at[2] = i;
        if (spread(path, at))
        {
            path->coarse_ends[0] = path->coarse_ends[1] == 0 ? i : path->coarse_ends[0];
            path->coarse_ends[1] = i + 1;
            error = error + error_of(path, at);
            distance = distance + (path->distance[at[4]] - path->distance[at[0]]) / 4.0;
        }
    }
}

/// Squared distance of a point from the chord of its neighbours.
static double sagitta_of(const maplines_path_t *path, size_t i)
{
    const double chord_x = path->dx[i - 1] + path->dx[i];
    const double chord_y = path->dy[i - 1] + path->dy[i];
    const double across = path->dx[i - 1] * path->dy[i] - path->dy[i - 1] * path->dx[i];
    return capped(across * across / (chord_x * chord_x + chord_y * chord_y), MOST_SAGITTA);
}

void maplines_prepare_path(const double *points, const double *distance, size_t count,
                           double *memory, maplines_path_t *path)
{
    double *x = memory;
    double *y = x + count;
    double *own_distance = y + count;
    double *dx = own_distance + count;
    double *dy = dx + count;
    double *squared = dy + count;
    double *cx = squared + count;
    double *cy = cx + count;
    double *chord = cy + count;
    double *errors = chord + count;
    double *sagittas = errors + count;
    double *coarse_errors = sagittas + count;
    double *coarse_distances = coarse_errors + count;
    const maplines_path_t made = {count,
                                  x,
                                  y,
                                  own_distance,
                                  dx,
                                  dy,
                                  squared,
                                  cx,
                                  cy,
                                  chord,
                                  errors,
                                  sagittas,
                                  coarse_errors,
                                  coarse_distances,
                                  {0, 0}};
    *path = made;
    bool has_short_steps = false;
    for (size_t i = 0; i < count; ++i)
    {
        x[i] = points[2 * i];
        y[i] = points[2 * i + 1];
        own_distance[i] = distance[i];
    }
    for (size_t i = 0; i < count; ++i)
    {
        const bool is_last = i + 1 == count;
        dx[i] = is_last ? 0.0 : x[i + 1] - x[i];
        dy[i] = is_last ? 0.0 : y[i + 1] - y[i];
        const double square = dx[i] * dx[i] + dy[i] * dy[i];
        squared[i] = square > DBL_MIN ? square : DBL_MIN;
        cx[i] = dx[i];
        cy[i] = dy[i];
        has_short_steps |= !is_last && distance[i + 1] - distance[i] < DIRECTION_BASE;
    }
    if (has_short_steps)
    {
        set_chords(x, y, distance, count, cx, cy);
    }
    double error = 0.0;
    double sagitta = 0.0;
    for (size_t i = 0; i < count; ++i)
    {
        chord[i] = maplines_hypot(cx[i], cy[i]);
        errors[i] = error;
        sagittas[i] = sagitta;
        error = error + (i >= 2 && i + 2 < count ? shown_error(path, i) : 0.0);
        sagitta = sagitta + (i >= 1 && i + 1 < count ? sagitta_of(path, i) : 0.0);
    }
    set_coarse(path, coarse_errors, coarse_distances);
}

void maplines_shown_errors(const maplines_path_t *path, double *squares)
{
    for (size_t i = 0; i < path->count; ++i)
    {
        squares[i] = i >= 2 && i + 2 < path->count ? shown_error(path, i) : 0.0;
    }
}

/// Mean of the terms of points, of which `sums` has the sums before each, from one place among the
/// points to another. A term extends half a point to both sides. Those from `ends[0]` to before
/// `ends[1]` are known. If there are less than `least`, those around count, too.
static double mean_of(size_t count, const double *sums, const size_t ends[2], double low,
                      double high, double least, double *terms)
{
    const double first = (double)ends[0];
    const double last = (double)ends[1];
    const double wider = (least - (high - low)) / 2.0;
    double begin = low + 0.5 - (wider > 0.0 ? wider : 0.0);
    double end = high + 0.5 + (wider > 0.0 ? wider : 0.0);
    *terms = 0.0;
    if (!(last > first))
    {
        return 0.0;
    }
    begin = begin < last - least ? begin : last - least;
    begin = begin > first ? begin : first;
    end = end > first + least ? end : first + least;
    end = end < last ? end : last;
    const size_t i = (size_t)begin;
    const size_t j = (size_t)end;
    const double of_begin = (begin - (double)i) * (sums[i + 1] - sums[i]);
    const double of_end = j + 1 < count ? (end - (double)j) * (sums[j + 1] - sums[j]) : 0.0;
    *terms = end - begin;
    return ((sums[j] - sums[i]) + (of_end - of_begin)) / (end - begin);
}

/* ---- the nearest step -------------------------------------------------------------------------
 */

/// Frame of a car.
typedef struct {
    double c, s;      ///< cosine and sine of its heading
    double x, y;      ///< [m]
    double least;     ///< cosine of the largest angle of a line
    double low, high; ///< window [m]
    double start[2];  ///< place from which lines are followed [m]
    double reach;     ///< how far along them [m]
} frame_t;

static frame_t frame_of(const maplines_look_t *look)
{
    const double low = look->window[0];
    const double high = look->window[1];
    const double behind = 0.0 > low ? 0.0 : low;
    const double ahead = behind < high ? behind : high;
    double sine_of_turn;
    frame_t frame = {0.0, 0.0, look->pose[0], look->pose[1], 0.0, low, high, {0.0, 0.0}, 0.0};
    maplines_sin_cos(look->pose[2], &frame.s, &frame.c);
    maplines_sin_cos(look->max_turn, &sine_of_turn, &frame.least);
    frame.start[0] = frame.x + ahead * frame.c;
    frame.start[1] = frame.y + ahead * frame.s;
    frame.reach = (high - low + fabs(ahead)) / frame.least;
    return frame;
}

void maplines_look_start(const maplines_look_t *look, double start[2], double *reach)
{
    const frame_t frame = frame_of(look);
    memcpy(start, frame.start, sizeof frame.start);
    *reach = frame.reach;
}

/// Direction of a step: 1 along the x axis of the car, -1 against it, 0 across it.
static int direction_of(const maplines_path_t *path, const frame_t *frame, size_t i)
{
    const double advance = frame->c * path->cx[i] + frame->s * path->cy[i];
    const double least = frame->least * path->chord[i];
    return (advance >= least ? 1 : 0) - (advance <= -least ? 1 : 0);
}

/// Where a step is nearest to the start, as a share of it.
static double share_of(const maplines_path_t *path, const frame_t *frame, size_t i)
{
    const double x = frame->start[0] - path->x[i];
    const double y = frame->start[1] - path->y[i];
    const double along = x * path->dx[i] + y * path->dy[i];
    double share = along / path->squared[i];
    share = share > 0.0 ? share : 0.0;
    return share < 1.0 ? share : 1.0;
}

/// Squared distance of a step from the start.
static double squared_distance(const maplines_path_t *path, const frame_t *frame, size_t i)
{
    const double share = share_of(path, frame, i);
    const double along_x = share * path->dx[i];
    const double along_y = share * path->dy[i];
    const double x = frame->start[0] - path->x[i] - along_x;
    const double y = frame->start[1] - path->y[i] - along_y;
    const double square = x * x + y * y;
    return square < (double)INFINITY ? square : (double)INFINITY; // NaN by overflow, too
}

/// The first of the nearest steps. What is nearer than some point by more than the way along the
/// line from there cannot be the nearest, and is not visited.
static size_t nearest_of_all(const maplines_path_t *path, const frame_t *frame)
{
    const size_t steps = path->count - 1;
    const double *distance = path->distance;
    double bound = (double)INFINITY;
    for (size_t i = 0; i < path->count; i += STRIDE)
    {
        const double x = frame->start[0] - path->x[i];
        const double y = frame->start[1] - path->y[i];
        const double square = x * x + y * y;
        bound = square < bound ? square : bound;
    }
    bound = sqrt(bound);
    double least = (double)INFINITY;
    size_t nearest = 0;
    size_t i = 0;
    while (i < steps)
    {
        const double square = squared_distance(path, frame, i);
        const double own = sqrt(square);
        const double end = distance[i] + (own - bound) - ROUNDING * (distance[steps] + own);
        nearest = square < least ? i : nearest;
        least = square < least ? square : least;
        ++i;
        while (i + STRIDE <= steps && distance[i + STRIDE] < end)
        {
            i += STRIDE;
        }
        while (i < steps && distance[i + 1] < end)
        {
            ++i;
        }
    }
    return nearest;
}

/// The nearest step that is not across the x axis of the car; false if there is none within reach.
static bool nearest_step(const maplines_path_t *path, const frame_t *frame, size_t *nearest)
{
    const size_t steps = path->count - 1;
    const size_t found = nearest_of_all(path, frame);
    *nearest = found;
    if (direction_of(path, frame, found) != 0)
    {
        return true;
    }
    const double length = path->distance[found + 1] - path->distance[found];
    const double along = share_of(path, frame, found) * length;
    const double place = path->distance[found] + along;
    double least = (double)INFINITY;
    bool is_near = false;
    for (size_t i = 0; i < steps; ++i)
    {
        if (direction_of(path, frame, i) != 0 && fabs(path->distance[i] - place) <= frame->reach)
        {
            const double square = squared_distance(path, frame, i);
            if (!is_near || square < least)
            {
                *nearest = i;
                least = square;
                is_near = true;
            }
        }
    }
    return is_near;
}

/* ---- the stretch around it --------------------------------------------------------------------
 */

/// A step between two x lies in the window, at least in part.
static bool is_inside(const frame_t *frame, double x, double next)
{
    return !((x <= frame->low && next <= frame->low) || (x >= frame->high && next >= frame->high));
}

/// An x is beyond the window: at its high end in the direction 1, at its low one in -1.
static bool is_beyond(const frame_t *frame, double x, int direction)
{
    return direction > 0 ? x >= frame->high : x <= frame->low;
}

/// Place of a point along the x axis of the car.
static double x_of(const maplines_path_t *path, const frame_t *frame, size_t i)
{
    const double c_east = frame->c * (path->x[i] - frame->x);
    const double s_north = frame->s * (path->y[i] - frame->y);
    return c_east + s_north;
}

/// How far a step from a point is outside of the window; negative if it is inside, at least in
/// part. The way along the line to the window is not shorter.
static double distance_outside(const maplines_path_t *path, const frame_t *frame, size_t from,
                               size_t to)
{
    const double x = x_of(path, frame, from);
    const double outside = x <= frame->low ? frame->low - x : x - frame->high;
    const double error = ROUNDING * (path->distance[path->count - 1] + fabs(x));
    const double way = outside > error ? outside - error : 0.0;
    return is_inside(frame, x, x_of(path, frame, to)) ? -1.0 : way;
}

/// No step from a point on is in the window.
static bool is_outside_after(const maplines_path_t *path, const frame_t *frame, size_t i)
{
    const size_t last = path->count - 1;
    double way = 0.0;
    while (i < last && way >= 0.0)
    {
        way = distance_outside(path, frame, i, i + 1);
        const double end = path->distance[i] + way;
        ++i;
        while (i + STRIDE <= last && path->distance[i + STRIDE] < end)
        {
            i += STRIDE;
        }
        while (i < last && path->distance[i + 1] < end)
        {
            ++i;
        }
    }
    return way >= 0.0;
}

/// No step to a point is in the window, nor one before.
static bool is_outside_before(const maplines_path_t *path, const frame_t *frame, size_t i)
{
    double way = 0.0;
    while (i > 0 && way >= 0.0)
    {
        way = distance_outside(path, frame, i, i - 1);
        const double end = path->distance[i] - way;
        --i;
        while (i >= STRIDE && path->distance[i - STRIDE] > end)
        {
            i -= STRIDE;
        }
        while (i > 0 && path->distance[i - 1] > end)
        {
            --i;
        }
    }
    return way >= 0.0;
}

/// First point of the run of steps in the direction of one, as far as it may be in the window.
static size_t begin_of_run(const maplines_path_t *path, const frame_t *frame, size_t step)
{
    const int direction = direction_of(path, frame, step);
    size_t first = step;
    while (first > 0 && direction_of(path, frame, first - 1) == direction &&
           !is_beyond(frame, x_of(path, frame, first), -direction))
    {
        --first;
    }
    if (!is_outside_before(path, frame, first))
    {
        while (first > 0 && direction_of(path, frame, first - 1) == direction)
        {
            --first;
        }
    }
    return first;
}

/// Last point of it.
static size_t end_of_run(const maplines_path_t *path, const frame_t *frame, size_t step)
{
    const int direction = direction_of(path, frame, step);
    size_t last = step + 1;
    while (last + 1 < path->count && direction_of(path, frame, last) == direction &&
           !is_beyond(frame, x_of(path, frame, last), direction))
    {
        ++last;
    }
    if (!is_outside_after(path, frame, last))
    {
        while (last + 1 < path->count && direction_of(path, frame, last) == direction)
        {
            ++last;
        }
    }
    return last;
}

/// Reverse an array.
static void reverse(size_t count, double *values)
{
    for (size_t i = 0; i < count / 2; ++i)
    {
        const double value = values[i];
        values[i] = values[count - 1 - i];
        values[count - 1 - i] = value;
    }
}

/// Share of a step that lies outside of a window; a step of no length has none.
static double share_outside(double outside, double step)
{
    return step > 0.0 ? outside / step : 0.0;
}

/// Kinks of a line that errors of its points hide: variance of what its direction changes in a
/// metre, if it changes at random [1/m].
///
/// Fourth differences of points h apart have a variance of 8/3 h^3 by kinks, and of 70 by errors.
/// So those are kinks that points far apart show beside the errors of close ones, up to what these
/// can hide.
static double hidden_kinks(const maplines_path_t *path, double low, double high, double error,
                           double typical, double spacing)
{
    double terms;
    const double coarse =
        mean_of(path->count, path->coarse_errors, path->coarse_ends, low, high, ERRORS, &terms);
    const double distance =
        mean_of(path->count, path->coarse_distances, path->coarse_ends, low, high, ERRORS, &terms);
    const double ratio = spacing / distance;
    const double closeness = ratio < 1.0 ? 1.0 - ratio * ratio : 0.0;
    const double explained = (AS_ERRORS_FAR + (AS_ERRORS - AS_ERRORS_FAR) * closeness) * error;
    const double rest = coarse - explained - typical * typical;
    const double kinks = PER_KINK * rest / (distance * distance * distance);
    const double most = HIDING * error / (1.0 + AVERAGED / spacing);
    const double product = kinks * most;
    return product > 0.0 ? product / (kinks + most) : 0.0;
}

/// Set what the points of a stretch show of their errors, and of the line between them. `first` is
/// the first of them in the path.
///
/// A typical error stands for what a line of few points cannot show. Two points are a straight
/// line.
static void set_errors(const maplines_path_t *path, size_t first, int direction, const double *x,
                       maplines_stretch_t *stretch)
{
    const size_t last = stretch->count - 1;
    const size_t inner[2] = {1, path->count - 1};
    const size_t innermost[2] = {2, path->count - 2};
    const double behind = share_outside(stretch->x_range[0] - x[0], x[1] - x[0]);
    const double ahead = share_outside(x[last] - stretch->x_range[1], x[last] - x[last - 1]);
    const double low = (double)first + (direction > 0 ? behind : ahead);
    const double high = (double)(first + last) - (direction > 0 ? ahead : behind);
    double errors;
    double sagittas;
    const double error = mean_of(path->count, path->errors, innermost, low, high, ERRORS, &errors);
    const double square =
        mean_of(path->count, path->sagittas, inner, low, high, SAGITTAS, &sagittas) - 1.5 * error;
    const double spacing = (stretch->x_range[1] - stretch->x_range[0]) / (high - low);
    const double usual = TYPICAL * spacing * spacing;
    const double typical = path->count == 2 ? 0.0 : usual < MOST_TYPICAL ? usual : MOST_TYPICAL;
    const double freedom = errors / PER_FREEDOM;
    const double all = freedom + TYPICAL_COUNT;
    const double share = TYPICAL_COUNT / all * (typical * typical);
    const double ratio = (all + 2.0) / (all + 2.0 - STUDENT);
    const double few = FEW_POINTS / (sagittas + 2.0);
    const double apart = 1.0 / (1.0 + FAR_APART / spacing);
    stretch->error = error;
    stretch->widened = (freedom / all * error + share) * (ratio * ratio) * (ratio * ratio);
    stretch->sagitta = square > 0.0 ? square : 0.0;
    stretch->bends = BETWEEN * stretch->sagitta * (1.0 + few * few * few * (few * few * few));
    stretch->kinks = hidden_kinks(path, low, high, error, typical, spacing);
    stretch->unseen = stretch->bends + BY_TYPICAL * share + BY_ERROR * error * apart;
}

/// Stretch around a step: the run of steps in its direction, and of these the ones in the window.
/// x and y have room for all points of the path. False if there is none.
static bool stretch_around(const maplines_path_t *path, const frame_t *frame, size_t nearest,
                           double *x, double *y, maplines_stretch_t *stretch)
{
    const int direction = direction_of(path, frame, nearest);
    const size_t first = begin_of_run(path, frame, nearest);
    const size_t last = end_of_run(path, frame, nearest);
    const size_t points = last - first + 1;
    for (size_t i = 0; i < points; ++i)
    {
        const double east = path->x[first + i] - frame->x;
        const double north = path->y[first + i] - frame->y;
        const double c_east = frame->c * east;
        const double s_north = frame->s * north;
        const double c_north = frame->c * north;
        const double s_east = frame->s * east;
        x[i] = c_east + s_north;
        y[i] = c_north - s_east;
    }
    size_t begin = 0;
    size_t end = points - 1;
    while (begin < end && !is_inside(frame, x[begin], x[begin + 1]))
    {
        ++begin;
    }
    while (end > begin && !is_inside(frame, x[end - 1], x[end]))
    {
        --end;
    }
    if (begin == end)
    {
        return false;
    }
    stretch->count = end - begin + 1;
    memmove(x, x + begin, stretch->count * sizeof *x);
    memmove(y, y + begin, stretch->count * sizeof *y);
    if (direction < 0)
    {
        reverse(stretch->count, x);
        reverse(stretch->count, y);
    }
    const double low = x[0];
    const double high = x[stretch->count - 1];
    stretch->x_range[0] = low > frame->low ? low : frame->low;
    stretch->x_range[1] = high < frame->high ? high : frame->high;
    if (!(stretch->x_range[0] < stretch->x_range[1]))
    {
        return false;
    }
    set_errors(path, first + begin, direction, x, stretch);
    return true;
}

/// Set keys and slopes of stretches, of which all else is set.
static void index_stretches(maplines_stretches_t *seen)
{
    double farthest = 0.0;
    for (size_t i = 0; i < seen->points; ++i)
    {
        farthest = fabs(seen->x[i]) > farthest ? fabs(seen->x[i]) : farthest;
    }
    seen->step = 2.0 * farthest + 1.0;
    double greatest = -(double)INFINITY;
    for (size_t line = 0; line < seen->lines; ++line)
    {
        const maplines_stretch_t *stretch = &seen->stretch[line];
        const double shift = (double)line * seen->step;
        for (size_t i = stretch->first; i < stretch->first + stretch->count; ++i)
        {
            const double key = seen->x[i] + shift;
            greatest = key > greatest ? key : greatest; // close points may run back a little
            seen->key[i] = greatest;
        }
    }
    for (size_t i = 0; i + 1 < seen->points; ++i)
    {
        seen->slope[i] = (seen->y[i + 1] - seen->y[i]) / (seen->key[i + 1] - seen->key[i]);
    }
    for (size_t line = 0; line < seen->lines; ++line)
    {
        const maplines_stretch_t *stretch = &seen->stretch[line];
        const double shift = (double)line * seen->step;
        size_t i = stretch->first;
        seen->area[i] = 0.0;
        seen->square[i] = 0.0;
        seen->cube[i] = 0.0;
        for (; i + 1 < stretch->first + stretch->count; ++i)
        {
            const double low = seen->key[i] - shift;
            const double high = seen->key[i + 1] - shift;
            const double length = high - low;
            const double square = length * length * length / 6.0;
            seen->area[i + 1] = seen->area[i] + (seen->y[i] + seen->y[i + 1]) / 2.0 * length;
            seen->square[i + 1] = seen->square[i] + square;
            seen->cube[i + 1] = seen->cube[i] + square * (1.5 * (low + high));
        }
    }
}

void maplines_see(const maplines_path_t *paths, size_t count, const maplines_look_t *look,
                  maplines_stretches_t *seen, maplines_omission_t *left_out)
{
    const frame_t frame = frame_of(look);
    seen->lines = 0;
    seen->points = 0;
    for (size_t i = 0; i < count; ++i)
    {
        size_t nearest = 0;
        maplines_stretch_t *stretch = &seen->stretch[seen->lines];
        stretch->first = seen->points;
        stretch->line = i;
        if (!nearest_step(&paths[i], &frame, &nearest))
        {
            left_out[i] = MAPLINES_ACROSS;
        }
        else if (!stretch_around(&paths[i], &frame, nearest, seen->x + seen->points,
                                 seen->y + seen->points, stretch))
        {
            left_out[i] = MAPLINES_NOT_IN_WINDOW;
        }
        else if (stretch->bends > look->max_unseen * look->max_unseen)
        {
            left_out[i] = MAPLINES_FEW_POINTS;
        }
        else
        {
            left_out[i] = MAPLINES_GIVEN;
            seen->points += stretch->count;
            ++seen->lines;
        }
    }
    index_stretches(seen);
}

/* ---- values of stretches ----------------------------------------------------------------------
 */

/// Index of the last of ascending keys, from one of which that is known, that is not greater.
static inline size_t next_point(const double *keys, size_t i, size_t last, double key)
{
    while (i + LEAP <= last && keys[i + LEAP] <= key)
    {
        i += LEAP;
    }
    while (i < last && keys[i + 1] <= key)
    {
        ++i;
    }
    return i;
}

/// Integrals of a stretch from its first point to the ends of cells: as those of its points.
typedef struct {
    double area[MAPLINES_CELLS + 1];
    double square[MAPLINES_CELLS + 1];
    double cube[MAPLINES_CELLS + 1];
} integrals_t;

/// Integrals to the ends of cells, and the positions of these.
static void integrate(const maplines_stretches_t *seen, size_t line, const double x_range[2],
                      int count, double *position, integrals_t *to)
{
    const double *key = seen->key;
    const double shift = (double)line * seen->step;
    const double begin = x_range[0];
    const double length = (x_range[1] - begin) / count;
    const size_t last = seen->stretch[line].first + seen->stretch[line].count - 1;
    size_t i = seen->stretch[line].first;
    for (int k = 0; k <= count; ++k)
    {
        const double offset = k * length;
        const double x = k < count ? begin + offset : x_range[1];
        i = next_point(key, i, last, x + shift);
        const double low = key[i] - shift;
        const double beyond = x - low;
        double area = seen->area[i];
        double square = seen->square[i];
        double cube = seen->cube[i];
        double place = (double)i;
        if (beyond > 0.0 && i < last)
        {
            const double step = key[i + 1] - key[i];
            const double beyond2 = beyond * beyond;
            const double by_two = step * beyond2 / 2.0 - beyond2 * beyond / 3.0;
            const double by_three = step * (beyond2 * beyond) / 3.0 - beyond2 * beyond2 / 4.0;
            area += beyond * (seen->y[i] + seen->slope[i] * beyond / 2.0);
            square += by_two;
            cube += by_three + (2.0 * low + key[i + 1] - shift) * by_two;
            place += beyond / step;
        }
        to->area[k] = area;
        to->square[k] = square;
        to->cube[k] = cube;
        position[k] = place;
    }
}

void maplines_divide(const maplines_stretches_t *seen, size_t line, const double x_range[2],
                     int count, maplines_cells_t *cells)
{
    const double centre = (x_range[0] + x_range[1]) / 2.0;
    const double half = (x_range[1] - x_range[0]) / 2.0;
    const double length = (x_range[1] - x_range[0]) / count;
    const double scale = 1.0 / (half * half * length);
    integrals_t to;
    integrate(seen, line, x_range, count, cells->position, &to);
    for (int k = 0; k < count; ++k)
    {
        const double square = to.square[k + 1] - to.square[k];
        cells->y[k] = (to.area[k + 1] - to.area[k]) / length;
        cells->square[k] = square * scale;
        cells->cube[k] = ((to.cube[k + 1] - to.cube[k]) - 3.0 * centre * square) * scale / half;
    }
}
