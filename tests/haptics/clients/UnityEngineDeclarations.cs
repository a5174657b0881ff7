// Declarations of the names of UnityEngine that docs/client_csharp.md uses, to compile its component without Unity.
namespace UnityEngine
{
    public class MonoBehaviour { }
    public struct Vector3
    {
        public float x, y, z;
        public Vector3(float x, float y, float z) { this.x = x; this.y = y; this.z = z; }
    }
    public struct Quaternion
    {
        public float x, y, z, w;
        public static Quaternion Inverse(Quaternion rotation) { return rotation; }
        public static Quaternion operator *(Quaternion first, Quaternion second) { return first; }
    }
    public class Transform
    {
        public Vector3 position { get { return new Vector3(); } }
        public Quaternion rotation { get { return new Quaternion { w = 1.0f }; } }
        public Vector3 InverseTransformPoint(Vector3 position) { return position; }
        public Vector3 TransformDirection(Vector3 direction) { return direction; }
    }
    public class Rigidbody
    {
        public void AddForceAtPosition(Vector3 force, Vector3 position) { }
        public void AddTorque(Vector3 torque) { }
    }
    public static class Time { public static double fixedTimeAsDouble { get { return 0.0; } } }
    public static class Debug { public static void LogWarning(object message) { } }
}
