/* Declarations of the names of Unreal Engine that docs/client_csharp.md uses, to compile its function without Unreal. */
struct FVector {
    double X, Y, Z;
    FVector(double x, double y, double z) : X(x), Y(y), Z(z) {}
};
struct FQuat {
    double X, Y, Z, W;
};
struct FTransform {
    FTransform GetRelativeTransform(const FTransform &) const { return *this; }
    FVector GetLocation() const { return FVector(0.0, 0.0, 0.0); }
    FQuat GetRotation() const { return FQuat{0.0, 0.0, 0.0, 1.0}; }
    FVector TransformVectorNoScale(const FVector &Vector) const { return Vector; }
};
struct UPrimitiveComponent {
    void AddForceAtLocation(FVector, FVector) {}
    void AddTorqueInRadians(FVector) {}
};
