// Client of `tissue-sim serve`, protocol versions 3 and 2, in one file. C# 7, only System.*: .NET, Mono, Unity.
//
// SI units. Frame: origin at the centre of the undeformed top face, z out of the tissue, right-handed; forces are those on
// the tool. `UnityFrame` converts poses, forces and torques. docs/client_csharp.md is the guide, and docs/wire_protocol.md
// defines the fields. A step creates no objects and throws no exception.
//
// Copyright: the tissue_sim authors; Apache License 2.0.
using System;
using System.Diagnostics;
using System.Net;
using System.Net.Sockets;
using System.Security.Cryptography;
using System.Threading;

namespace TissueSim
{
    /// <summary>Status of a reply. Below 100 the reply has a force, from 100 on it has none.</summary>
    public enum Status
    {
        Converged = 0,      // in equilibrium
        Late = 1,           // the time budget ended: force and stiffness extrapolated from the last equilibrium
        Stopped = 2,        // no equilibrium found: the same extrapolation; move back, or reset
        Refused = 3,        // pose or time beyond the limits of the scene: the last force; nothing changed
        Fading = 4,         // no equilibrium for too long: force and stiffness decrease to zero
        Returning = 5,      // in equilibrium: force and stiffness increase along a ramp
        Failed = 6,         // the step failed and the tissue was rebuilt: no force
        Busy = 100,         // another client owns the tissue
        OtherVersion = 101, // the server does not speak the version of the request
        Released = 102      // answer to a goodbye
    }

    /// <summary>Result of a call. After any other result than Ok the reply is unchanged: no new force.</summary>
    public enum Outcome
    {
        Ok,
        NoReply,      // within the time-out; the next call tries again
        NoServer,     // nothing listens on that port, or the packet could not be sent
        OtherVersion, // the server speaks another version of the protocol
        BadPose,      // not finite, or the quaternion is not a unit quaternion; nothing was sent
        BadReply,     // a force is not finite or above LargestForce
        Busy,         // Connect: another client owns the tissue
        NotAReply     // Wire.DecodeReply: the bytes are not a reply
    }

    /// <summary>Request of a client: pose of the tool at a time.</summary>
    public sealed class Request
    {
        public int Version = 3;
        public int Kind = Wire.Step;
        public ulong Sequence;
        public double Time;                                         // on the client's clock, s
        public ulong Session;
        public double[] Position = new double[3];                   // x, y, z, m; depth is -z
        public double[] Orientation = new double[] { 1, 0, 0, 0 };  // unit quaternion w, x, y, z
        public uint Flags;                                          // Wire.Reset or 0
    }

    /// <summary>Reply of the server: force on the tool, its stiffness, and information on its accuracy.</summary>
    public sealed class Reply
    {
        public int Version;
        public int Status;                                   // see the enumeration Status; newer servers may use more values
        public ulong Sequence;                               // of the request
        public double Time;                                  // of the request, s
        public ulong Session;                                // of the request
        public readonly double[] Force = new double[3];      // on the tool, N
        public readonly double[] Torque = new double[3];     // on the tool about its tip, N m
        public readonly double[] Stiffness = new double[36]; // by rows: minus d(force, torque) / d(position, rotation vector)
        public readonly double[] StepStiffness = new double[36]; // the same within this step, with the mass of the tissue
        public double Age;                                   // time since the last equilibrium, s
        public double ComputeTime;                           // of the step, s
        public double Residual;                              // relative residual of the forces
        public double Dt;                                    // time step that was used, s
        public uint Iterations;
        public uint Flags;
        public ulong Malformed, Stale, Skipped, TurnedAway;  // packets since the server started
        // The following fields belong to version 3; they are 0 in version 2.
        public double StiffnessAge;                          // time since the stiffness was evaluated, s
        public double ForceError;                            // estimated error of the force, N; NaN if unknown
        public double ErrorAge;                              // time since this error was estimated, s
        public double LeastToolMass;                         // smallest tool mass of a stable explicit coupling, kg
        // Set by TissueClient.Step.
        public bool IsFirst;  // no time step although time advanced: first step at this server, also after its restart,
                              // or the tissue was reset or restored since the previous reply,
                              // or an unanswered request was repeated with the same time

        public bool HasForce { get { return Status < 100; } }
        public bool IsInertial { get { return (Flags & 1) != 0; } }
        public bool IsLimited { get { return (Flags & 2) != 0; } }
        public bool IsStiffnessStale { get { return (Flags & 4) != 0; } }
        public bool IsOnAxis { get { return Version < 3 || (Flags & 8) == 0; } }
        public bool HasForceError { get { return Version >= 3 && !double.IsNaN(ForceError); } }
    }

    /// <summary>Encode requests and decode replies.</summary>
    public static class Wire
    {
        public const int RequestSize = 96;
        public const int ReplySize = 760;         // of version 3, the largest one
        public const int ReplySizeVersion2 = 728;
        public const int Step = 1;                // kinds of requests
        public const int Goodbye = 2;
        public const uint Reset = 1;              // flag: reset the tissue to its undeformed state before this step

        /// <summary>Write the packet of a request into 96 bytes. Its numbers are not checked.</summary>
        public static void EncodeRequest(Request request, byte[] packet)
        {
            int at = 0;
            foreach (char letter in "TSRQ")
                packet[at++] = (byte)letter;
            Put(packet, ref at, (ulong)request.Version, 2);
            Put(packet, ref at, (ulong)request.Kind, 2);
            Put(packet, ref at, request.Sequence, 8);
            Put(packet, ref at, request.Time);
            Put(packet, ref at, request.Session, 8);
            for (int k = 0; k < 3; k++)
                Put(packet, ref at, request.Position[k]);
            for (int k = 0; k < 4; k++)
                Put(packet, ref at, request.Orientation[k]);
            Put(packet, ref at, request.Flags, 4);
            Put(packet, ref at, 0, 4);
        }

        /// <summary>Read a reply of version 2 or 3. Returns Ok, NotAReply (wrong first bytes or size), or OtherVersion
        /// (then only version, status, sequence and time are set).</summary>
        public static Outcome DecodeReply(byte[] packet, int size, Reply reply)
        {
            if (size < 24 || packet[0] != 'T' || packet[1] != 'S' || packet[2] != 'R' || packet[3] != 'P')
                return Outcome.NotAReply;
            int at = 4;
            reply.Version = (int)Get(packet, ref at, 2);
            reply.Status = (int)Get(packet, ref at, 2);
            reply.Sequence = Get(packet, ref at, 8);
            reply.Time = GetDouble(packet, ref at);
            if (reply.Version != 2 && reply.Version != 3)
                return Outcome.OtherVersion;
            if (size != (reply.Version == 2 ? ReplySizeVersion2 : ReplySize))
                return Outcome.NotAReply;
            reply.Session = Get(packet, ref at, 8);
            GetDoubles(packet, ref at, reply.Force);
            GetDoubles(packet, ref at, reply.Torque);
            GetDoubles(packet, ref at, reply.Stiffness);
            GetDoubles(packet, ref at, reply.StepStiffness);
            reply.Age = GetDouble(packet, ref at);
            reply.ComputeTime = GetDouble(packet, ref at);
            reply.Residual = GetDouble(packet, ref at);
            reply.Dt = GetDouble(packet, ref at);
            reply.Iterations = (uint)Get(packet, ref at, 4);
            reply.Flags = (uint)Get(packet, ref at, 4);
            reply.Malformed = Get(packet, ref at, 8);
            reply.Stale = Get(packet, ref at, 8);
            reply.Skipped = Get(packet, ref at, 8);
            reply.TurnedAway = Get(packet, ref at, 8);
            bool isVersion3 = reply.Version >= 3;
            reply.StiffnessAge = isVersion3 ? GetDouble(packet, ref at) : 0.0;
            reply.ForceError = isVersion3 ? GetDouble(packet, ref at) : 0.0;
            reply.ErrorAge = isVersion3 ? GetDouble(packet, ref at) : 0.0;
            reply.LeastToolMass = isVersion3 ? GetDouble(packet, ref at) : 0.0;
            reply.IsFirst = false;
            return Outcome.Ok;
        }

        /// <summary>Meaning of a status in words.</summary>
        public static string GetText(int status)
        {
            switch ((Status)status)
            {
                case Status.Converged: return "in equilibrium at this pose";
                case Status.Late: return "the time budget ended: force and stiffness of the last equilibrium, extrapolated";
                case Status.Stopped: return "no equilibrium found: force and stiffness of the last one, extrapolated";
                case Status.Refused: return "the pose or the time is beyond the limits of the scene: the last force";
                case Status.Fading: return "no equilibrium for too long: force and stiffness decrease to zero";
                case Status.Returning: return "in equilibrium: force and stiffness increase along a ramp";
                case Status.Failed: return "the step failed, and the tissue was rebuilt: no force";
                case Status.Busy: return "another client owns the tissue; try again after its goodbye or its silence";
                case Status.OtherVersion: return "the server uses the protocol version of this reply";
                case Status.Released: return "the client has said goodbye; the tissue is free for another client";
                default: return "unknown status of a newer server";
            }
        }

        static void Put(byte[] packet, ref int at, ulong value, int bytes)
        {
            for (int k = 0; k < bytes; k++)
                packet[at++] = (byte)(value >> (8 * k));
        }

        static void Put(byte[] packet, ref int at, double value)
        {
            Put(packet, ref at, (ulong)BitConverter.DoubleToInt64Bits(value), 8);
        }

        static ulong Get(byte[] packet, ref int at, int bytes)
        {
            ulong value = 0;
            for (int k = 0; k < bytes; k++)
                value |= (ulong)packet[at++] << (8 * k);
            return value;
        }

        static double GetDouble(byte[] packet, ref int at)
        {
            return BitConverter.Int64BitsToDouble((long)Get(packet, ref at, 8));
        }

        static void GetDoubles(byte[] packet, ref int at, double[] values)
        {
            for (int k = 0; k < values.Length; k++)
                values[k] = GetDouble(packet, ref at);
        }
    }

    /// <summary>Send poses to a tissue server, and wait for the forces. One thread at a time.</summary>
    public sealed class TissueClient : IDisposable
    {
        readonly Socket socket;
        readonly Request request = new Request();
        readonly byte[] packet = new byte[Wire.RequestSize];
        readonly byte[] answer = new byte[Wire.ReplySize + 1];
        readonly double[] origin = new double[3];
        readonly double[] upright = { 1, 0, 0, 0 };
        readonly Reply ownReply = new Reply();
        double lastTime = double.NegativeInfinity;  // of the last answered step, also of a late reply
        int answerSize;                             // bytes of the last packet in `answer`
        double timeout;
        bool hasFirst;                              // whether a late or refused reply was the first of a server

        /// <summary>Longest wait for a reply, s.</summary>
        /// <exception cref="ArgumentException">the value is not finite or not above 0.</exception>
        public double Timeout
        {
            get { return timeout; }
            set
            {
                if (!(value > 0.0) || double.IsInfinity(value))
                    throw new ArgumentException("timeout must be positive and finite; got " + value + " s");
                timeout = value;
            }
        }

        /// <summary>Replies with a larger force are refused, N; initially 1000, above the limit of any server.</summary>
        public double LargestForce = 1000.0;

        /// <summary>Last error as one sentence; it has both versions after OtherVersion.</summary>
        public string Message { get; private set; }

        /// <summary>Number that identifies this client at the server; initially random. Set it before the first step
        /// for a server with --session.</summary>
        public ulong Session { get { return request.Session; } set { request.Session = value; } }

        /// <summary>Create a client of a server; sends no packet.</summary>
        /// <param name="port">UDP port of the server.</param>
        /// <param name="host">numeric address of the server.</param>
        /// <param name="timeout">longest wait for a reply, s, above 0.</param>
        /// <param name="version">protocol version, 3 or 2.</param>
        public TissueClient(int port, string host = "127.0.0.1", double timeout = 1.0, int version = 3)
        {
            Timeout = timeout;
            if (version != 2 && version != 3)
                throw new ArgumentException("version must be 2 or 3; got " + version);
            IPAddress address;
            if (!IPAddress.TryParse(host, out address))
                throw new ArgumentException("host must be a numeric address such as 127.0.0.1; got " + host);
            Message = "";
            request.Version = version;
            byte[] random = new byte[8];
            using (RandomNumberGenerator source = RandomNumberGenerator.Create())
                source.GetBytes(random);
            request.Session = BitConverter.ToUInt64(random, 0) | 1;
            socket = new Socket(address.AddressFamily, SocketType.Dgram, ProtocolType.Udp);
            socket.Connect(new IPEndPoint(address, port));
            socket.Blocking = false;
        }

        /// <summary>Wait until a server answers: at the start, or after it was restarted. Asks every 20 ms.</summary>
        /// <returns>Ok if the tissue is free, Busy if another client owns it. A tissue that this client owned is
        /// released: the next step starts with IsFirst.</returns>
        public Outcome Connect(double longestWait)
        {
            Stopwatch clock = Stopwatch.StartNew();
            for (;;)
            {
                Outcome outcome = Ask(Wire.Goodbye, 0.0, origin, upright, 0, Math.Max(0.05, Timeout));
                if (outcome == Outcome.Ok)
                {
                    lastTime = double.NegativeInfinity;
                    hasFirst = false;
                    return ownReply.Status == (int)Status.Busy
                        ? Fail(Outcome.Busy, Wire.GetText((int)Status.Busy)) : Outcome.Ok;
                }
                if (outcome != Outcome.NoServer && outcome != Outcome.NoReply || clock.Elapsed.TotalSeconds >= longestWait)
                    return outcome;
                Thread.Sleep(20);
            }
        }

        /// <summary>Send a pose and wait for its force. After NoReply or NoServer call it again: it reaches the server as
        /// soon as that answers, also after a restart. Ask for a reset again until the reply has a force and its status
        /// is neither Refused nor Failed: the other replies do not confirm the reset.</summary>
        /// <param name="time">the client's clock, s; it must not decrease.</param>
        /// <param name="position">x, y, z, m.</param>
        /// <param name="orientation">unit quaternion w, x, y, z.</param>
        /// <param name="reset">whether the tissue is reset to its undeformed state before this step.</param>
        /// <param name="reply">reply that is filled if the result is Ok; otherwise unchanged.</param>
        public Outcome Step(double time, double[] position, double[] orientation, bool reset, Reply reply)
        {
            double square = 0.0;
            for (int k = 0; k < 4; k++)
                square += orientation[k] * orientation[k];
            // A length of 1 within 1e-3, as at the server; false for NaN.
            bool isValid = IsFinite(time) && square >= 0.999 * 0.999 && square <= 1.001 * 1.001;
            for (int k = 0; k < 3; k++)
                isValid = isValid && IsFinite(position[k]);
            if (!isValid)
                return Fail(Outcome.BadPose, "time and pose must be finite, and the orientation a unit quaternion");
            Outcome outcome = Ask(Wire.Step, time, position, orientation, reset ? Wire.Reset : 0, Timeout);
            if (outcome != Outcome.Ok)
                return outcome;
            if (!ownReply.HasForce)
            {
                Message = Wire.GetText(ownReply.Status);
                return Wire.DecodeReply(answer, answerSize, reply);
            }
            // Stored before the force is checked: after BadReply the next reply states it.
            if (IsFirstStep(ownReply))
                hasFirst = true;
            double[] f = ownReply.Force;
            double[] t = ownReply.Torque;
            if (!(f[0] * f[0] + f[1] * f[1] + f[2] * f[2] <= LargestForce * LargestForce)
                || !IsFinite(t[0]) || !IsFinite(t[1]) || !IsFinite(t[2]))
                return Fail(Outcome.BadReply, "the force of the reply is not finite, or above the largest force of the client");
            Wire.DecodeReply(answer, answerSize, reply);
            reply.IsFirst = hasFirst;
            hasFirst = false;
            return Outcome.Ok;
        }

        /// <summary>Release the tissue for other clients, and close the socket.</summary>
        public void Dispose()
        {
            if (socket.Connected)
                Ask(Wire.Goodbye, 0.0, origin, upright, 0, Timeout);
            socket.Close();
        }

        // Send one request and wait for its own reply. Every reply is decoded into ownReply, which is valid only if the
        // result is Ok; `answer` then contains its packet.
        Outcome Ask(int kind, double time, double[] position, double[] orientation, uint flags, double longestWait)
        {
            request.Kind = kind;
            request.Time = time;
            Array.Copy(position, request.Position, 3);
            Array.Copy(orientation, request.Orientation, 4);
            request.Flags = flags;
            Wire.EncodeRequest(request, packet);
            ulong sequence = request.Sequence++;
            long end = Stopwatch.GetTimestamp() + (long)(longestWait * Stopwatch.Frequency);
            SocketError error;
            // The first attempt may report that nothing listened at the time of an earlier packet.
            if (socket.Send(packet, 0, packet.Length, SocketFlags.None, out error) != packet.Length &&
                socket.Send(packet, 0, packet.Length, SocketFlags.None, out error) != packet.Length)
                return Fail(Outcome.NoServer, NoServerText);
            for (;;)
            {
                answerSize = socket.Receive(answer, 0, answer.Length, SocketFlags.None, out error);
                if (error == SocketError.ConnectionRefused || error == SocketError.ConnectionReset)
                    return Fail(Outcome.NoServer, NoServerText);
                if (error == SocketError.Success)
                {
                    Outcome outcome = Wire.DecodeReply(answer, answerSize, ownReply);
                    if (outcome != Outcome.NotAReply && ownReply.Version != request.Version)
                        return Fail(Outcome.OtherVersion, "the server uses protocol version " + ownReply.Version
                            + ", this client version " + request.Version + "; install the same tissue_sim on both sides");
                    if (outcome == Outcome.Ok && ownReply.Session == request.Session)
                    {
                        if (ownReply.Sequence == sequence)
                            return Outcome.Ok;
                        if (ownReply.Sequence < sequence && ownReply.Time > lastTime && IsFirstStep(ownReply))
                            hasFirst = true;
                    }
                }
                double rest = (double)(end - Stopwatch.GetTimestamp()) / Stopwatch.Frequency;
                if (rest <= 0.0)
                    return Fail(Outcome.NoReply, "no reply within the time-out");
                if (error != SocketError.Success)
                    socket.Poll((int)Math.Min(1e6, 1e6 * rest + 1.0), SelectMode.SelectRead);
            }
        }

        // Return whether the server made no time step although time advanced, and store the time of the reply.
        bool IsFirstStep(Reply reply)
        {
            if (!reply.HasForce || reply.Status == (int)Status.Refused)
                return false;
            bool isFirst = !(reply.Dt > 0.0) && reply.Time > lastTime;
            lastTime = reply.Time;
            return isFirst;
        }

        const string NoServerText = "nothing listens on that port; start tissue-sim serve";

        Outcome Fail(Outcome outcome, string sentence)
        {
            Message = sentence;
            return outcome;
        }

        static bool IsFinite(double value)
        {
            return !double.IsNaN(value) && !double.IsInfinity(value);
        }
    }

    /// <summary>Conversion between the frame of tissue_sim and that of Unity.
    ///
    /// Scene: right-handed, z out of the tissue, m, quaternion w, x, y, z. Unity: left-handed, y up, m, quaternion
    /// x, y, z, w. The map M exchanges y and z; it is a reflection. Positions and forces are vectors: M v. Torques and the
    /// vector part of a quaternion are axial vectors, which a reflection maps to det(M) M v = -M v.</summary>
    public static class UnityFrame
    {
        /// <summary>Position or force, both directions: exchange y and z.</summary>
        public static void ConvertVector(double[] vector, double[] converted)
        {
            double y = vector[1];
            converted[0] = vector[0];
            converted[1] = vector[2];
            converted[2] = y;
        }

        /// <summary>Torque or rotation vector, both directions: exchange y and z, and change the sign.</summary>
        public static void ConvertTorque(double[] torque, double[] converted)
        {
            double y = torque[1];
            converted[0] = -torque[0];
            converted[1] = -torque[2];
            converted[2] = -y;
        }

        /// <summary>Orientation in the scene (w, x, y, z) from a quaternion of Unity.</summary>
        public static void ConvertOrientationFromUnity(double x, double y, double z, double w, double[] orientation)
        {
            orientation[0] = w;
            orientation[1] = -x;
            orientation[2] = -z;
            orientation[3] = -y;
        }

        /// <summary>Quaternion of Unity (x, y, z, w) from an orientation in the scene (w, x, y, z).</summary>
        public static void ConvertOrientationToUnity(double[] orientation, double[] quaternion)
        {
            quaternion[0] = -orientation[1];
            quaternion[1] = -orientation[3];
            quaternion[2] = -orientation[2];
            quaternion[3] = orientation[0];
        }
    }
}
