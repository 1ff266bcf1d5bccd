#ifndef ECHOGRID_H
#define ECHOGRID_H

#include <math.h> /* INFINITY and NAN alone; nothing of libm is called */
#include <stdint.h>

#ifdef __FAST_MATH__
#error "echogrid: found -ffast-math, expected arithmetic that knows NaN and INFINITY"
#endif

#ifdef __cplusplus
extern "C" {
#endif

#define ECHOGRID_SONARS $sonars
#define ECHOGRID_SIDE $side /* cells along a side of the window */
#define ECHOGRID_CELL_M $cell
#define ECHOGRID_CELLS (ECHOGRID_SIDE * ECHOGRID_SIDE)

/* Ranges are in metres. */
#define ECHOGRID_NO_ECHO INFINITY /* fired, and nothing came back */
#define ECHOGRID_SILENT NAN       /* not fired, or not valid */

/* A cell is told as log-odds of a surface: +127 is 7.9, -127 is -7.9; p = 1 / (1 + exp(-cell / 16.0)). */
#define ECHOGRID_PER_LOG_ODDS 16
#define ECHOGRID_UNKNOWN (-128) /* no scan spoke of the cell since it came into the window */

/* What echogrid_scan returns. */
#define ECHOGRID_DONE 0
#define ECHOGRID_BAD_POSE 1 /* not finite, or farther than ECHOGRID_FAR_M (100 turns) from 0; nothing was changed */
#define ECHOGRID_FAR_M 1000.0f

#define ECHOGRID_PLACES $places /* places and headings that are remembered to have been looked from */

struct echogrid_heard {
    float range, x, y, theta;
    uint32_t ms, scan;
};

struct echogrid_place {
    uint32_t key;
    float looks;
};

/* All that is kept of a drive; yours to put where there is room. Its fields are of no concern outside. */
struct echogrid {
    int32_t row, col; /* of the window's first cell, counted from the world's origin */
    uint32_t scans, dither;
    float last_x, last_y;
    float trait_sums[4], trait_counts[4];
    struct echogrid_heard heard[ECHOGRID_SONARS];
    struct echogrid_place places[ECHOGRID_PLACES];
    float reach[$bearings];
    uint16_t sums[ECHOGRID_CELLS][5];
    int16_t polar[$bearings][$rings];
    uint8_t marks[ECHOGRID_CELLS];
};

/* Begin a drive: everything is unknown. */
void echogrid_start(struct echogrid* map);

/*
 * Take a scan into the map.
 *
 * ranges: of each sonar, m, in the order of the robot's mounts; raw ones will do: at or past the sonar's maximum is
 * no echo, below its minimum not valid.
 *
 * x, y, theta: the robot in the world, m and rad, counter-clockwise from x.
 *
 * ms: time, in ms from anywhere; it may wrap. It says which readings of silent sonars are old.
 *
 * Returns ECHOGRID_DONE or ECHOGRID_BAD_POSE.
 */
int echogrid_scan(struct echogrid* map, const float ranges[ECHOGRID_SONARS], float x, float y, float theta,
                  uint32_t ms);

/* The lower left corner of the window, m, world; the robot of the last scan is in its middle. */
void echogrid_corner(const struct echogrid* map, float* x, float* y);

/* One cell of the window, row 0 lowest y, col 0 lowest x; unknown where there is none. */
int8_t echogrid_cell(const struct echogrid* map, int32_t row, int32_t col);

/* The whole window, row after row. */
void echogrid_read(const struct echogrid* map, int8_t cells[ECHOGRID_CELLS]);

#ifdef __cplusplus
}
#endif

#endif
