/* What is seen of lines of the map. */
#include "propagation.h"

#include <float.h>

#define DIRECTION_BASE 0.5 ///< over which the direction of a line is taken [m]

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
    const maplines_path_t made = {count, x, y, own_distance, dx, dy, squared, cx, cy, chord};
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
    for (size_t i = 0; i < count; ++i)
    {
        chord[i] = maplines_hypot(cx[i], cy[i]);
    }
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

/// Squared distances of the steps from the start.
static void squared_distances(const maplines_path_t *path, const frame_t *frame, double *squared)
{
    for (size_t i = 0; i + 1 < path->count; ++i)
    {
        const double share = share_of(path, frame, i);
        const double along_x = share * path->dx[i];
        const double along_y = share * path->dy[i];
        const double x = frame->start[0] - path->x[i] - along_x;
        const double y = frame->start[1] - path->y[i] - along_y;
        const double square = x * x + y * y;
        squared[i] = square < (double)INFINITY ? square : (double)INFINITY; // NaN by overflow, too
    }
}

/// The nearest step that is not across the x axis of the car; false if there is none within reach.
static bool nearest_step(const maplines_path_t *path, const frame_t *frame, double *squared,
                         size_t *nearest)
{
    const size_t steps = path->count - 1;
    size_t found = 0;
    squared_distances(path, frame, squared);
    for (size_t i = 1; i < steps; ++i)
    {
        found = squared[i] < squared[found] ? i : found;
    }
    *nearest = found;
    if (direction_of(path, frame, found) != 0)
    {
        return true;
    }
    const double length = path->distance[found + 1] - path->distance[found];
    const double along = share_of(path, frame, found) * length;
    const double place = path->distance[found] + along;
    bool is_near = false;
    for (size_t i = 0; i < steps; ++i)
    {
        if (direction_of(path, frame, i) != 0 && fabs(path->distance[i] - place) <= frame->reach &&
            (!is_near || squared[i] < squared[*nearest]))
        {
            *nearest = i;
            is_near = true;
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

/// Stretch around a step: the run of steps in its direction, and of these the ones in the window.
/// x and y have room for all points of the path. False if there is none.
static bool stretch_around(const maplines_path_t *path, const frame_t *frame, size_t nearest,
                           double *x, double *y, maplines_stretch_t *stretch)
{
    const int direction = direction_of(path, frame, nearest);
    size_t first = nearest;
    size_t last = nearest + 1; // point
    while (first > 0 && direction_of(path, frame, first - 1) == direction)
    {
        --first;
    }
    while (last + 1 < path->count && direction_of(path, frame, last) == direction)
    {
        ++last;
    }
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
    return stretch->x_range[0] < stretch->x_range[1];
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
        if (!nearest_step(&paths[i], &frame, seen->key + seen->points, &nearest))
        {
            left_out[i] = MAPLINES_ACROSS;
        }
        else if (!stretch_around(&paths[i], &frame, nearest, seen->x + seen->points,
                                 seen->y + seen->points, stretch))
        {
            left_out[i] = MAPLINES_NOT_IN_WINDOW;
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

/// Index of the last point whose key is not greater, from one of which that is known.
static size_t next_point(const maplines_stretches_t *seen, double key, size_t i)
{
    while (i + 1 < seen->points && seen->key[i + 1] <= key)
    {
        ++i;
    }
    return i;
}

/// The same from the points of a stretch.
static size_t first_point(const maplines_stretches_t *seen, size_t line, double key)
{
    size_t low = seen->stretch[line].first;
    size_t high = low + seen->stretch[line].count;
    low = low > 0 ? low - 1 : 0; // rounding may take the end of a range to the stretch before
    while (high - low > 1)
    {
        const size_t middle = low + (high - low) / 2;
        if (seen->key[middle] <= key)
        {
            low = middle;
        }
        else
        {
            high = middle;
        }
    }
    return low;
}

void maplines_lateral(const maplines_stretches_t *seen, size_t line, size_t count, const double *x,
                      double *y)
{
    const double shift = (double)line * seen->step;
    size_t i = first_point(seen, line, x[0] + shift);
    for (size_t k = 0; k < count; ++k)
    {
        const double key = x[k] + shift;
        i = next_point(seen, key, i);
        const double beyond = key - seen->key[i];
        const bool is_between = beyond > 0.0 && i + 1 < seen->points;
        y[k] = is_between ? seen->slope[i] * beyond + seen->y[i] : seen->y[i];
    }
}

void maplines_positions(const maplines_stretches_t *seen, size_t line, size_t count,
                        const double *x, double *position)
{
    const double shift = (double)line * seen->step;
    size_t i = first_point(seen, line, x[0] + shift);
    for (size_t k = 0; k < count; ++k)
    {
        const double key = x[k] + shift;
        i = next_point(seen, key, i);
        position[k] = (double)i;
        if (key > seen->key[i] && i + 1 < seen->points)
        {
            const double slope = 1.0 / (seen->key[i + 1] - seen->key[i]);
            position[k] = slope * (key - seen->key[i]) + (double)i;
        }
    }
}
