/* Made by magbridge export from calibration $id: do not edit.
 *
 * Compile with -DMAGBRIDGE_FLOAT for float; otherwise double. No allocation, no state, no other library than
 * sqrt() of the mathematical one.
 */
#ifndef MAGBRIDGE_CALIBRATION_H
#define MAGBRIDGE_CALIBRATION_H

#ifdef MAGBRIDGE_FLOAT
typedef float magbridge_real;
#else
typedef double magbridge_real;
#endif

#define MAGBRIDGE_CALIBRATION_ID 0x${id}u
#define MAGBRIDGE_PARAMETERS $count
$names
#define MAGBRIDGE_CONDITIONS $conditions
$condition_names
/* the corrected field, nT; body axes, or the sensor's where MAGBRIDGE_BORESIGHT is 0 */
#define MAGBRIDGE_BORESIGHT $boresight
typedef struct {
    magbridge_real total, total_sigma;
    magbridge_real field[3], field_sigma[3];
    int extrapolated; /* a parameter is outside the calibrated range, or a condition far outside */
} magbridge_corrected;

/* field: as read, nT, sensor axes; parameters: in the order and the units above. NaN gives NaN.
 * conditions: likewise, but NaN if unknown, and a depth of 0 above the surface. The sigmas grow outside the
 * range of a condition. */
void magbridge_correct(const magbridge_real field[3], const magbridge_real *parameters,
                       const magbridge_real *conditions, magbridge_corrected *out);

#endif
