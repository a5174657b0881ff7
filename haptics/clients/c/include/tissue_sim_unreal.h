/* Conversion between the frame of tissue_sim and that of Unreal Engine. C99 or C++, no engine headers.
 *
 * Scene: right-handed, z out of the tissue, m, quaternion w, x, y, z. Unreal: left-handed, z up, cm, FQuat x, y, z, w.
 * The map is the reflection M = diag(1, -1, 1). Positions and forces are vectors: M v. Torques and the vector part of a
 * quaternion are axial vectors, which a reflection maps to det(M) M v = -M v. Unreal's unit of force is kg cm/s^2
 * (1 N = 100) and that of torque kg cm^2/s^2 (1 N m = 10000).
 *
 * Copyright: the tissue_sim authors; Apache License 2.0.
 */
#ifndef TISSUE_SIM_UNREAL_H
#define TISSUE_SIM_UNREAL_H

#define TISSUE_SIM_UNREAL_CM_PER_M 100.0
#define TISSUE_SIM_UNREAL_FORCE_PER_N 100.0
#define TISSUE_SIM_UNREAL_TORQUE_PER_NM 10000.0

/* Pose of the tool in the scene (m; w, x, y, z) from its pose relative to the scene in Unreal (cm; x, y, z, w). */
static inline void tissue_sim_pose_from_unreal(const double location_cm[3], const double quaternion_xyzw[4],
                                               double position[3], double orientation_wxyz[4])
{
    position[0] = location_cm[0] / TISSUE_SIM_UNREAL_CM_PER_M;
    position[1] = -location_cm[1] / TISSUE_SIM_UNREAL_CM_PER_M;
    position[2] = location_cm[2] / TISSUE_SIM_UNREAL_CM_PER_M;
    orientation_wxyz[0] = quaternion_xyzw[3];
    orientation_wxyz[1] = -quaternion_xyzw[0];
    orientation_wxyz[2] = quaternion_xyzw[1];
    orientation_wxyz[3] = -quaternion_xyzw[2];
}

/* Pose in Unreal (cm; x, y, z, w) from a pose in the scene (m; w, x, y, z). */
static inline void tissue_sim_pose_to_unreal(const double position[3], const double orientation_wxyz[4],
                                             double location_cm[3], double quaternion_xyzw[4])
{
    location_cm[0] = TISSUE_SIM_UNREAL_CM_PER_M * position[0];
    location_cm[1] = -TISSUE_SIM_UNREAL_CM_PER_M * position[1];
    location_cm[2] = TISSUE_SIM_UNREAL_CM_PER_M * position[2];
    quaternion_xyzw[0] = -orientation_wxyz[1];
    quaternion_xyzw[1] = orientation_wxyz[2];
    quaternion_xyzw[2] = -orientation_wxyz[3];
    quaternion_xyzw[3] = orientation_wxyz[0];
}

/* Force (kg cm/s^2) and torque about the tip (kg cm^2/s^2) in Unreal from those of an answer (N, N m). */
static inline void tissue_sim_wrench_to_unreal(const double force[3], const double torque[3], double force_unreal[3],
                                               double torque_unreal[3])
{
    force_unreal[0] = TISSUE_SIM_UNREAL_FORCE_PER_N * force[0];
    force_unreal[1] = -TISSUE_SIM_UNREAL_FORCE_PER_N * force[1];
    force_unreal[2] = TISSUE_SIM_UNREAL_FORCE_PER_N * force[2];
    torque_unreal[0] = -TISSUE_SIM_UNREAL_TORQUE_PER_NM * torque[0];
    torque_unreal[1] = TISSUE_SIM_UNREAL_TORQUE_PER_NM * torque[1];
    torque_unreal[2] = -TISSUE_SIM_UNREAL_TORQUE_PER_NM * torque[2];
}

#endif /* TISSUE_SIM_UNREAL_H */
