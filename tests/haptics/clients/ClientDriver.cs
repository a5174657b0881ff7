// Execute the commands of tests/haptics/test_clients.py, one a line. Doubles are 16 hexadecimal digits of their bits.
using System;
using System.Globalization;
using System.Text;
using TissueSim;

static class ClientDriver
{
    static string[] words;
    static int at;
    static readonly Reply got = new Reply();  // reply of the last step

    static ulong NextInteger() { return ulong.Parse(words[at++], CultureInfo.InvariantCulture); }

    static double NextDouble()
    {
        return BitConverter.Int64BitsToDouble((long)ulong.Parse(words[at++], NumberStyles.HexNumber, CultureInfo.InvariantCulture));
    }

    static double[] NextDoubles(int count)
    {
        double[] values = new double[count];
        for (int k = 0; k < count; k++)
            values[k] = NextDouble();
        return values;
    }

    static string Hex(params double[] values)
    {
        StringBuilder text = new StringBuilder();
        foreach (double value in values)
            text.Append(' ').Append(((ulong)BitConverter.DoubleToInt64Bits(value)).ToString("x16"));
        return text.ToString();
    }

    static string NameOf(Outcome outcome)
    {
        switch (outcome)
        {
            case Outcome.Ok: return "ok";
            case Outcome.NoReply: return "no_reply";
            case Outcome.NoServer: return "no_server";
            case Outcome.OtherVersion: return "other_version";
            case Outcome.BadPose: return "bad_pose";
            case Outcome.BadReply: return "bad_reply";
            case Outcome.NotAReply: return "not_a_reply";
            case Outcome.Busy: return "busy";
            default: return "other";
        }
    }

    static string Encode()
    {
        Request request = new Request();
        request.Version = (int)NextInteger();
        request.Kind = (int)NextInteger();
        request.Sequence = NextInteger();
        request.Time = NextDouble();
        request.Session = NextInteger();
        request.Position = NextDoubles(3);
        request.Orientation = NextDoubles(4);
        request.Flags = (uint)NextInteger();
        byte[] packet = new byte[Wire.RequestSize];
        Wire.EncodeRequest(request, packet);
        return BitConverter.ToString(packet).Replace("-", "").ToLowerInvariant();
    }

    static string Decode()
    {
        string text = words[at++];
        int size = text == "-" ? 0 : text.Length / 2;
        byte[] packet = new byte[size];
        for (int k = 0; k < size; k++)
            packet[k] = byte.Parse(text.Substring(2 * k, 2), NumberStyles.HexNumber);
        Reply got = new Reply();
        Outcome outcome = Wire.DecodeReply(packet, size, got);
        if (outcome == Outcome.OtherVersion)
            return NameOf(outcome) + " " + got.Version;
        if (outcome != Outcome.Ok)
            return NameOf(outcome);
        string flags = "";
        foreach (bool flag in new[] { got.IsInertial, got.IsLimited, got.IsStiffnessStale, got.IsOnAxis, got.HasForceError })
            flags += flag ? "1" : "0";
        return "ok " + got.Version + " " + got.Status + " " + got.Sequence + Hex(got.Time) + " " + got.Session
            + Hex(got.Force) + Hex(got.Torque) + Hex(got.Stiffness) + Hex(got.StepStiffness)
            + Hex(got.Age, got.ComputeTime, got.Residual, got.Dt) + " " + got.Iterations + " " + got.Flags + " "
            + got.Malformed + " " + got.Stale + " " + got.Skipped + " " + got.TurnedAway
            + Hex(got.StiffnessAge, got.ForceError, got.ErrorAge, got.LeastToolMass) + " " + flags;
    }

    static string Step(TissueClient client)
    {
        double time = NextDouble();
        double[] position = NextDoubles(3);
        double[] orientation = NextDoubles(4);
        Outcome outcome = client.Step(time, position, orientation, NextInteger() == 1, got);
        if (outcome == Outcome.Ok && got.HasForce)
            return "ok " + got.Status + " " + (got.IsFirst ? 1 : 0) + Hex(got.Force) + Hex(got.Dt);
        return (outcome == Outcome.Ok ? got.Status == (int)Status.Busy ? "busy" : "other" : NameOf(outcome))
            + " " + client.Message;
    }

    // Pose and wrench of the scene in Unity, and the pose back in the scene.
    static string Convert()
    {
        double[] position = NextDoubles(3), orientation = NextDoubles(4), force = NextDoubles(3), torque = NextDoubles(3);
        double[] there = new double[3], quaternion = new double[4], back = new double[3], orientationBack = new double[4];
        UnityFrame.ConvertVector(position, there);
        UnityFrame.ConvertOrientationToUnity(orientation, quaternion);
        UnityFrame.ConvertVector(force, force);
        UnityFrame.ConvertTorque(torque, torque);
        UnityFrame.ConvertVector(there, back);
        UnityFrame.ConvertOrientationFromUnity(quaternion[0], quaternion[1], quaternion[2], quaternion[3], orientationBack);
        return "ok" + Hex(there) + Hex(quaternion) + Hex(force) + Hex(torque) + Hex(back) + Hex(orientationBack);
    }

    static void Main()
    {
        TissueClient client = null;
        string line;
        while ((line = Console.ReadLine()) != null)
        {
            words = line.Split(' ');
            at = 1;
            string answer = "unknown";
            switch (words[0])
            {
                case "encode": answer = Encode(); break;
                case "decode": answer = Decode(); break;
                case "convert": answer = Convert(); break;
                case "open":
                    int port = (int)NextInteger();
                    double timeout = NextDouble();
                    client = new TissueClient(port, "127.0.0.1", timeout, (int)NextInteger());
                    answer = "ok";
                    break;
                case "connect":
                    Outcome outcome = client.Connect(NextDouble());
                    answer = NameOf(outcome) + " " + (outcome == Outcome.Ok ? "" : client.Message);
                    break;
                case "largest": client.LargestForce = NextDouble(); answer = "ok"; break;
                case "timeout":
                    try
                    {
                        client.Timeout = NextDouble();
                        answer = "ok";
                    }
                    catch (ArgumentException error)
                    {
                        answer = "refused " + error.Message;
                    }
                    break;
                case "force": answer = "ok" + Hex(got.Force); break;
                case "step": answer = Step(client); break;
                case "close": client.Dispose(); answer = "ok"; break;
            }
            Console.WriteLine(answer);
            Console.Out.Flush();
        }
    }
}
