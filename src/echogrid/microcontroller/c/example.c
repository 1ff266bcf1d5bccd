/* Scans in, a map out, drawn as text; put your driver in the place of read_sonars. */
#include <stdio.h>

#include "echogrid.h"

static struct echogrid map; /* large: not on the stack */

static void read_sonars(float ranges[ECHOGRID_SONARS]) {
    for (int sonar = 0; sonar < ECHOGRID_SONARS; sonar++) {
        ranges[sonar] = 1.5f; /* m; ECHOGRID_NO_ECHO, or ECHOGRID_SILENT where it did not fire */
    }
}

static char drawn(int cell) { /* p > 0.73, p < 0.27, else and unknown */
    return cell > ECHOGRID_PER_LOG_ODDS ? '#' : cell < -ECHOGRID_PER_LOG_ODDS && cell != ECHOGRID_UNKNOWN ? '.' : ' ';
}

int main(void) {
    float ranges[ECHOGRID_SONARS];
    echogrid_start(&map);
    for (uint32_t scan = 0; scan < 20; scan++) {
        read_sonars(ranges);
        /* x, y in m and heading in rad from your odometry; time in ms. Here the robot turns on the spot. */
        if (echogrid_scan(&map, ranges, 0.0f, 0.0f, 0.3f * (float)scan, 100 * scan) != ECHOGRID_DONE) {
            return 1;
        }
    }
    for (int row = ECHOGRID_SIDE - 1; row >= 0; row--) {
        for (int col = 0; col < ECHOGRID_SIDE; col++) {
            putchar(drawn(echogrid_cell(&map, row, col)));
        }
        putchar('\n');
    }
    return 0;
}
