float4* row = reinterpret_cast<float4*>(records.data) + 3ll * i;
row[0] = make_float4(v[0], v[1], v[2], v[3]);
row[1] = make_float4(v[4], v[5], v[6], v[7]);
row[2] = make_float4(v[8], v[9], v[10], v[11]);
